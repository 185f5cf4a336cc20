"""Learn a size calibration from known lumps."""
