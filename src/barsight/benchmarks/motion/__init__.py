"""Benchmarks of feature matching and of the estimators' speed."""
