"""Write result files, and the pages that show them."""
