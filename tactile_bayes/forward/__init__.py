"""Forward models: from a scene of lumps to what the scan head measures."""
