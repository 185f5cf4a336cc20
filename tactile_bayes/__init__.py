"""Lump size with an honest credible interval from tactile maps of the breast (research use only)."""

__version__ = "0.1.0"
