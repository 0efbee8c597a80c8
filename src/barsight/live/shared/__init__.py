"""Share numbers, pairs and logs among the processes of a run."""
