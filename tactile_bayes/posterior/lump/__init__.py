"""The Gaussian bump and the cells that it is fitted to, whatever the noise model."""
