"""Monitor a rig over the years with control charts (CUSUM) on the figures of every survey since the last
approval.
"""
