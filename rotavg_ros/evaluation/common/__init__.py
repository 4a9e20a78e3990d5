"""What all suites consist of: cases, contenders, answers, scores and tables."""
