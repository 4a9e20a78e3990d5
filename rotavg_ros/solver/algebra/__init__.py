"""What all solves are made of: sorted edges, sparse systems, spanning forests, quaternions in rows, coarse threads."""
