"""Posterior of a bump under independent errors."""
