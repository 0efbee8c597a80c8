"""Solve linear systems (dense and skyline Cholesky) and nonlinear ones (Levenberg-Marquardt)."""
