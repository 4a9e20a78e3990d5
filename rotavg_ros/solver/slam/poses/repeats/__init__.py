"""Evidence from other closures about the wrong places that each may join: places are mistaken repeatedly."""
