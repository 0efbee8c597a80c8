"""One module per migration, each frozen once released."""
