"""One module a command: parse, load, call one function, write."""
