"""A bump under independent errors."""
