"""The `rotavg` command: one module per subcommand."""
