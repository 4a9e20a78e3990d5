"""Named kinds of robots' graphs that are hard in one known way each: what they are drawn from, and their list."""
