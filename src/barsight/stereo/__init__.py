"""Floor 2: dense stereo. One file per method, each a function from a rectified pair to `Disparity`."""
