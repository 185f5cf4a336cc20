"""Every read and write of a file, one format a module."""
