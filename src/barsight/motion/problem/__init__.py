"""The estimation problem: states, factors, normal equations, Gauss-Newton, marginals."""
