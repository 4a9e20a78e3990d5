"""How good the solver, the estimator and the node are, beside other methods and beside the truth."""
