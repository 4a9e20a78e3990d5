"""What an answer says about the graph: orientations in their gauge, verdicts, positions, pictures."""
