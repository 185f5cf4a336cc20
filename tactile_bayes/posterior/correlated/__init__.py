"""A bump, and what may stand beside it, under spatially correlated errors."""
