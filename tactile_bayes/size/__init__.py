"""From amplitude and widths of a map to the size of a lump in mm."""
