"""The search for slips and false groups, where no small step leads to a better solution."""
