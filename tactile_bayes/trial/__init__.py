"""Method comparison of size estimates against excision.

`readings` gathers sizes a mass at a time; `summary` runs everything. Families of figures: `accuracy`, `origin_line`,
`spread`, `replicates`, `method_comparison` (with `lines`, `passing_bablok`, `bland_altman`, `concordance` below it),
`comparison` and `paired`. Intervals over patients: `sums`, `figures`, `jackknife`, `bootstrap`, `misses`,
`patient_limits`, and `check_intervals`, which counts how often they cover. Warnings: `plausibility`, `cautions`. Stated
uncertainty: `coverage`, `calibration`. Beyond the trial: `next_mass`, `planning`.
"""

from __future__ import annotations
