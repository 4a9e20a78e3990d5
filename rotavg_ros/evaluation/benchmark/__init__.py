"""Time and memory compared with the peers, every contender in a process of its own."""
