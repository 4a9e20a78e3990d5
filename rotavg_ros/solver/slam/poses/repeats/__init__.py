"""Evidence from other closures about the wrong places that each may join, since places are mistaken repeatedly."""
