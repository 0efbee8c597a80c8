"""Linear algebra of the estimators: skyline Cholesky, Schur complement, their kernels."""
