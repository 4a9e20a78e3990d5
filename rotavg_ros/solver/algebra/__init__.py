"""Building blocks of all solves: sorted edges, sparse systems, spanning forests, quaternions in rows."""
