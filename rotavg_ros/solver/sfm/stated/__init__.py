"""What edges state of their own noise, believed as far as residuals bear it out."""
