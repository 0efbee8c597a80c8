"""The page's API: its routes, the forms that they take, and the server that runs them."""
