"""Accept a rig with artefacts: find them, judge errors with their uncertainty, name causes, certify."""
