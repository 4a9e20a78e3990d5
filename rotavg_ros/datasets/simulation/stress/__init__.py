"""Named kinds of robots' graphs, each hard in one known way: how they are drawn, and their list."""
