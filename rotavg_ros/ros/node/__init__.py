"""What a robot runs."""
