"""Another answer, where edges that the first one rejects agree with each other."""
