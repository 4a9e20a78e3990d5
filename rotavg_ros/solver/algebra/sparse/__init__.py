"""Sparse symmetric systems: factors, by SuperLU and by dense fronts, Laplacians, conjugate gradients."""
