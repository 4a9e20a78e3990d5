"""What each subcommand can be told. No torch, scipy or rosbags here, so that `--help` and mistakes come at once."""
