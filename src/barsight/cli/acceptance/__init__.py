"""Run the commands for acceptance: commission, accept, budget, verify."""
