"""Linear algebra: skyline Cholesky and the Levenberg-Marquardt loop."""
