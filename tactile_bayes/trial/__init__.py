"""Method comparison of size estimates against excision.

One family of estimators a module, each with a ``figures`` function from `ModalitySizes` to named `Figure`s:
`accuracy` (percent and mm errors, bias), `origin_line` (slope through zero and its r squared), `spread` (within one
mass). `proportion`, `jackknife` and `coverage` serve them; `summary` runs them all. A new family is a new module and a
line in ``summary.FAMILIES``.
"""

from __future__ import annotations
