"""Actions of the commands: they read files, call the API, and print lines."""
