"""Run the commands of acceptance: accept."""
