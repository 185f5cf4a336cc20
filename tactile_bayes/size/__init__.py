"""Size calibrations: from a map's amplitude and widths to a lump's size in mm."""
