"""Write result files, and the page that shows them."""
