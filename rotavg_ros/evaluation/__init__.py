"""How good the solver, the estimator and the node are, compared with other methods and with the truth."""
