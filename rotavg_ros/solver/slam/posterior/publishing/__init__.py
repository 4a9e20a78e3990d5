"""What is published of the labellings that the search has found."""
