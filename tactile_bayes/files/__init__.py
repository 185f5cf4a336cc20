"""Reading and writing of files, by subject."""
