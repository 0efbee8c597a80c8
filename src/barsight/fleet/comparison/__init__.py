"""Compare two versions of an archive: each recording, all of them held against chance, and the page."""
