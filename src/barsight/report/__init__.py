"""Floor 7: result files, and the page that shows them."""
