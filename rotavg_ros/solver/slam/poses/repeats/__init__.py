"""What other closures say of the wrong places that each may join: places are mistaken again and again."""
