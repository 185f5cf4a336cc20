"""Simulated scans through the whole path: calibration populations, simulation-based calibration, trade-offs."""
