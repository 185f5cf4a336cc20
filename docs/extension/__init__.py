"""What the site generates from the program when it is built."""
