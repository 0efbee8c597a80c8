"""Track features: stereo features, motion prediction, consensus on a relative pose."""
