"""What every suite is made of: cases, who solves them, their answers, scores and tables."""
