"""Time and memory beside the peers, every contender in a process of its own."""
