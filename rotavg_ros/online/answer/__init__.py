"""What is said of the graph: orientations in their gauge, verdicts, positions, pictures."""
