"""Method comparison of size estimates against excision."""
