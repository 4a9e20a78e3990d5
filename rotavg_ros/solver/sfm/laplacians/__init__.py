"""Systems of least squares of the SfM refinement, whose edges weigh by matrices."""
