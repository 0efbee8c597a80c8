"""Solve the estimators' linear algebra: Schur complement, elimination, ordering, and their kernels."""
