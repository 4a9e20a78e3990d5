"""Running solves: abandoning them, counting their work, suspending them, and their threads."""
