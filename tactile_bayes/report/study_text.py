"""A forward study in a few lines."""

from __future__ import annotations

from collections.abc import Sequence

from tactile_bayes.forward.plane.study import DETECTABLE, StudyRow, learn_as_printed, stiffness_changes


def study_text(rows: Sequence[StudyRow]) -> str:
    """How many cases show; for each seat Eq 6 in two stages along each axis of the head, and Fig 7b in a line."""
    shown = sum(row.detectable for row in rows)
    lines = [f"{len(rows)} cases, {len(rows) - shown} not detectable (amplitude below {DETECTABLE:g}, or not resolved)"]
    heads = dict.fromkeys(row.head for row in rows if row.head is not None)
    if heads:
        lines.append(f"head: {', '.join(heads)}")
    axes = (
        {"x": ", across the head", "y": ", along it"} if any(row.sigma_y_mm is not None for row in rows) else {"x": ""}
    )
    for seat in dict.fromkeys(row.seat for row in rows):
        for axis, words in axes.items():
            learned = learn_as_printed([row for row in rows if row.seat == seat], axis=axis)
            if learned is not None:
                lines.append(
                    f"{seat}, E2/E1 = 100{words}: d = {learned.m:.2f} (sigma / delta) {learned.b_mm:+.2f} mm, "
                    f"delta = {learned.e:.3f} a^{learned.f:.3f} from {learned.cases} cases "
                    "(Eq 6 in two stages, as printed)"
                )
        changes = stiffness_changes([row for row in rows if row.seat == seat])
        if changes:
            cells = ", ".join(f"{100 * change:.1f} % at {d:g} mm" for d, change in changes.items())
            lines.append(f"{seat}, width at h/d 1 from E2/E1 = 8 on: within {cells}")
    return "\n".join(lines)
