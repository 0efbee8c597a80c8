"""Accept a rig by artefacts: find them, judge errors with their uncertainty, name causes, certify."""
