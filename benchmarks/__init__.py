"""What the program costs, as ratios to named peers measured in the same run; never part of the tests' verdict."""
