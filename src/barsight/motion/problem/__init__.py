"""Define and solve the estimation problem: states, factors, normal equations, marginals."""
