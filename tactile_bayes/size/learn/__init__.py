"""Learning of size calibrations from known lumps."""
