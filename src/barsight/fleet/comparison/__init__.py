"""Compare two versions of an archive: each recording, the significance over all of them, and the page."""
