"""Alembic migrations of the store, which run when a store is opened."""
