"""Define the page's API: its routes, their forms, and the server that runs them."""
