"""From a scan to a tactile map (paper steps i to iii)."""
