"""How certain an SfM answer is: deviations of orientations, and parts that may be in the wrong place."""
