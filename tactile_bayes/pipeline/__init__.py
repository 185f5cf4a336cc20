"""From a map's file to its answer: which calibration, which options, which estimate, in one place for every caller."""
