"""Forward models: what a scene of lumps shows to the scan head."""
