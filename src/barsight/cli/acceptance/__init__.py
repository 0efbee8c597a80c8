"""Run the commands of acceptance: commission, accept, budget, verify."""
