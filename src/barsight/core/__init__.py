"""Floor 0: errors, frozen types, poses that know their frames, time stamps, uncertainty, atomic files."""
