"""Posterior of a bump, and of neighbouring structures, under spatially correlated errors."""
