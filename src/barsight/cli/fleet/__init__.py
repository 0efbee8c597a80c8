"""Commands of the fleet: an archive measured anew, compared, promoted."""
