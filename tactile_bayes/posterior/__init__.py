"""From a tactile map to a posterior over width, amplitude and size."""
