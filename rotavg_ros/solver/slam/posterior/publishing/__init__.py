"""The published answer, from the labellings that the search has found."""
