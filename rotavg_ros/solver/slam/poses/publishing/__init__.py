"""What is published of poses: those of all nodes, their uncertainties, verdicts, and the median of rivals."""
