"""A state file: what it holds, its backups and its lock."""
