"""The Gaussian bump and the cells that it is fitted to, for every noise model."""
