"""What plays to a node and listens to it, to demonstrate and to measure."""
