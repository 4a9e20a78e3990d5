"""Plays data to a node and records its outputs, for demonstrations and measurements."""
