"""One module for each group of commands: options, and one call of what they do."""
