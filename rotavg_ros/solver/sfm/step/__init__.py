"""One least-squares step of the SfM refinement: residuals, robust weights, and the linear system."""
