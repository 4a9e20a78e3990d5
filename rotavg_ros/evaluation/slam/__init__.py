"""The suite of robots' pose graphs."""
