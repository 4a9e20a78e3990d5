"""What the node listens to."""
