"""Method comparison of size estimates against excision: readings, figures with intervals over patients, planning."""
