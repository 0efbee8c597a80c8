"""Measure the archive of many cranes anew: plan, run on Dask, compare two versions, promote one."""
