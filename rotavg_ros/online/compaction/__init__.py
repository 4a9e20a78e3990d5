"""What a full graph does without."""
