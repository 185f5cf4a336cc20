"""`calibrate array`: learn an array's calibration from recorded bladder steps, for `record` to attach."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_bayes.errors import BadDataError
from tactile_bayes.presets import RESEARCH_USE

if TYPE_CHECKING:
    from datetime import date

    from tactile_bayes.hardware.bladder import ArrayFit
    from tactile_bayes.scan import Scan


def calibrate_array(
    steps: tuple[tuple[float, Path], ...], output: Path, *, head_id: str | None, day: date, force: bool
) -> str:
    """Fit the calibration, write it, and print the result."""
    from tactile_bayes.files.instrument_json import ArrayCalibrationFile, write_array_calibration
    from tactile_bayes.files.provenance import Provenance, hash_inputs
    from tactile_bayes.files.scan_mcap import read_scan
    from tactile_bayes.hardware.bladder import BladderStep, fit_array

    scans = [read_scan(path) for _, path in steps]
    head = head_id or _one_head(scans)
    full = scans[0].element_calibration.saturation_count
    levels = []
    for (kpa, path), scan in zip(steps, scans, strict=True):
        try:
            levels.append(BladderStep.of(kpa, scan.frames.counts, saturation_count=full))
        except BadDataError as error:
            raise error.at(path) from None
    fit = fit_array(levels, saturation_count=full)
    inputs = hash_inputs(**{f"step_{number}": path for number, (_, path) in enumerate(steps, start=1)})
    made = Provenance("calibrate array", {"pressure_kpa": [kpa for kpa, _ in steps]}, inputs)
    content = ArrayCalibrationFile(fit.calibration, head, day, _quality(fit))
    write_array_calibration(output, content, provenance=made, force=force)
    return _text(fit, head, output)


def _one_head(scans: list[Scan]) -> str:
    found = {scan.session.get("head_id", "") for scan in scans}
    shapes = {scan.head.shape for scan in scans}
    if len(found) > 1 or len(shapes) > 1:
        raise BadDataError("the steps are of two heads or more", way_out="give steps of one head, or --head-id")
    (head,) = found
    if not head:
        raise BadDataError("the steps do not say which head they are of", way_out="give --head-id")
    return head


def _quality(fit: ArrayFit) -> dict[str, Any]:
    def shares(values: Any) -> list[float | None]:
        return [None if value != value else float(value) for value in values]

    return {
        "pressure_kpa": fit.pressure_kpa.tolist(),
        "nonuniformity": shares(fit.nonuniformity),
        "nonuniformity_with_curvature": shares(fit.curved_nonuniformity),
        "curvature_kpa_per_count2": fit.curvature_kpa_per_count2.tolist(),
        "dead": [list(taxel) for taxel in fit.dead],
        "hot": [list(taxel) for taxel in fit.hot],
    }


def _text(fit: ArrayFit, head: str, output: Path) -> str:
    gain = fit.calibration.gain_kpa_per_count
    lines = [f"{output}: {gain.size} taxels of head {head}, {len(fit.pressure_kpa)} steps"]
    for name, taxels in (("dead", fit.dead), ("hot", fit.hot)):
        places = ", ".join(f"row {row} column {column}" for row, column in taxels)
        lines.append(f"{name} taxels: {places or 'none'}")
    for kpa, line, curve in zip(fit.pressure_kpa, fit.nonuniformity, fit.curved_nonuniformity, strict=True):
        if line == line:
            lines.append(f"{kpa:g} kPa: residual non-uniformity {100 * line:.2f} %, with curvature {100 * curve:.2f} %")
    return "\n".join([*lines, RESEARCH_USE]) + "\n"
