"""Serial devices: scan heads, magnetic trackers, emulators and the recorder."""
