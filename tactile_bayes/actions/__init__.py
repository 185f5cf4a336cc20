"""What the commands do, once their options are read: the printing half of the command line."""
