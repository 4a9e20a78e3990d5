"""The alternation of sparse solves and verdicts."""
