"""Floor 1: camera models, the stereo rig, rectification."""
