"""Join the maps of several passes over one yard: ties between them, changes, and a common surface."""
