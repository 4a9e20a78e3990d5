"""Moves of the search: each proposes where, and a predicted change of F; F alone accepts."""
