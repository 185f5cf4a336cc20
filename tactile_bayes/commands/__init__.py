"""One module per command: parse options, load files, call one function, write results."""
