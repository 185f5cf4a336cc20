"""What the commands do once their options are read: files in, calls of the API, lines out."""
