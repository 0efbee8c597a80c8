"""The archive of many cranes, measured anew: plan, run on Dask, compare two versions, promote one."""
