"""What training sees of robots' graphs and their solves."""
