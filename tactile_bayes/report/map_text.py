"""A map in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from tactile_bayes.findings import finding_lines, verdict
from tactile_bayes.mapping.accumulate import LEAST_SHARE
from tactile_bayes.mapping.map import FEW_READINGS, TactileMap, advise_cell, skewed
from tactile_bayes.mapping.plausibility import WHY_NOT
from tactile_bayes.mapping.profile import SPAN_MM
from tactile_bayes.presets import CELL_PER_SIGMA, RESEARCH_USE

# --- Text report of a tactile map: its verdict in a few lines, or a table with units, then what was left out.

_LISTED_TAXELS = 8
# Leaving out more frames than this share for their pressure is worth a word about the window.
_MUCH_GATED = 0.2
_UNITS = {
    "mean": "times the mean of their frames (normalise mean)",
    "gain": "times the level beside a lump (normalise gain)",
}
_DROPPED = WHY_NOT | {"dropped_low": "pressed below {0:g} kPa", "dropped_high": "pressed above {1:g} kPa"}
# Rows of the full report: a name, the figure without which there is none, and the text; after "+" what is added to it.
_ROWS: Final = """
frames | frame_rate_hz | {frame_rate_hz:.1f} Hz, jitter {frame_jitter_ms:.2f} ms, {frames_missing:.0f} missing
poses | pose_rate_hz | {pose_rate_hz:.1f} Hz, {pose_repeats:.0f} repeats dropped, longest gap {pose_gap_ms:.0f} ms
latency | latency_sd_ms | {latency_ms:.2f} +- {latency_sd_ms:.2f} ms, from {latency_frames:.0f} frames
+ | latency_sd_ms |  (a mobile lump mimics one)
 | latency_bound_ms | noise of readings and tracker alone would leave +-{latency_bound_ms:.2f} ms
plane | plane_rms_mm | rms {plane_rms_mm:.1f} mm, {tilt_deg:.1f} deg from the head's face
  fitted to | plane_condition | {fitted_to}
+ | plane_radius_mm |  within {plane_radius_mm:.0f} mm of the mass
+ | plane_condition | ; longest over second spread {plane_condition:.1f}
rotations | normal_agreement | face and motion agree to {normal_agreement:.3f} of 1, as the quaternions are told
head | plane_rms_mm | turned by {yaw_sd_deg:.1f} deg (SD), moved {span_x_mm:.0f} x {span_y_mm:.0f} mm
patient axes | plane_rms_mm | {patient_axes}
strokes | strokes | {strokes_known:.0f} of {strokes:.0f} shifted onto each other
  shifts | strokes | along x, mm; {shifts}
mobility | mobility_mm | {mobility_mm:.2f} +- {mobility_sd_mm:.2f} mm with the head
+ | mobility_mm |  (a latency left in the poses looks alike)
frames' places | pose_noise_x_mm | known to {pose_noise_x_mm:.2f} by {pose_noise_y_mm:.2f} mm
+ | pose_noise_x_mm |  (SD a frame, by its neighbours)
head profile | head_profile_frames | second order {head_profile_x2:+.3f} across, {head_profile_y2:+.3f} along,
+ | head_profile_frames |  from {head_profile_frames:.0f} frames without a lump
  evenness | profile_change | changes by {profile_change:.3f} +- {profile_change_sd:.3f} over {span_mm:g} mm
+ | stroke_skew | ; skewed along the strokes by {stroke_skew:+.3f} +- {stroke_skew_sd:.3f}
skin | skin_curvature_per_m | curved by {skin_curvature_per_m:+.1f} per m along the head's path (convex above 0)
stroke lag | stroke_lag_mm | lump ahead by {stroke_lag_mm:+.2f} +- {stroke_lag_sd_mm:.2f} mm along the strokes
+ | stroke_lag_mm |  (below 0: a latency left in the poses)
flat field | flat_field_frames | from {flat_field_frames:.0f} frames without a lump;
+ | flat_field_frames |  taxels differ by {flat_field_percent:.1f} % (SD)
"""


def map_summary(tactile_map: TactileMap, *, written: str) -> str:
    """Short report of a map: its verdict with the figures that lead to it, and the names of the files written."""
    findings, quality = tactile_map.findings, tactile_map.quality
    rows, columns = tactile_map.mean.shape
    cell = tactile_map.recipe.cell_mm
    dropped = "; ".join(_dropped(tactile_map))
    lines = [
        *finding_lines(findings, "caution"),
        _verdict_line(tactile_map),
        *([f"left out: {dropped}"] if dropped else []),
        f"written: {written}, {columns * cell:g} x {rows * cell:g} mm in cells of {cell:g} mm",
        *finding_lines(findings, "check"),
        *_advice(quality),
        "More (timing, plane, pressure, noise): map -v.",
    ]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _verdict_line(tactile_map: TactileMap) -> str:
    """Whether the map is sound, with the figures that lead to it."""
    quality = tactile_map.quality
    used = dict(_frames(tactile_map)).get("frames used", "")
    number, *more = used.split(", ")
    figures = [f"{number} frames", *more] if used else []
    if "coverage" in quality:
        figures.append(f"{100 * quality['coverage']:.0f} % covered")
    if "stroke_lag_mm" in quality:
        figures.append(f"stroke lag {quality['stroke_lag_mm']:+.2f} +- {quality['stroke_lag_sd_mm']:.2f} mm")
    return f"{verdict(tactile_map.findings, answered=True)}: {', '.join(figures)}"


def map_text(tactile_map: TactileMap) -> str:
    """Full report of a map: cautions and verdict, a table, what is to be checked, notes and the research-use line."""
    parts = (_what, _frames, _making, _cells)
    rows = [row for part in parts for row in part(tactile_map)]
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {text}" for name, text in rows]
    cautions, checks = (finding_lines(tactile_map.findings, one) for one in ("caution", "check"))
    head = [*cautions, _verdict_line(tactile_map), ""]
    return "\n".join([*head, *lines, "", *checks, *_notes(tactile_map), RESEARCH_USE]) + "\n"


def _what(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Size of the map and the range of its values."""
    rows, columns = tactile_map.mean.shape
    cell = tactile_map.recipe.cell_mm
    yield "map", f"{columns * cell:g} x {rows * cell:g} mm (across x along the head), cells of {cell:g} mm"
    values = tactile_map.mean[tactile_map.covered]
    if values.size:
        recipe = tactile_map.recipe
        units = _UNITS.get(recipe.normalise, f"{recipe.value_unit or 'of unknown unit'} (normalise none)")
        yield "values", f"{values.min():.3g} to {values.max():.3g} {units}"


def _frames(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Frames used and left out, each with its reason."""
    quality = tactile_map.quality
    if "frames_total" not in quality:
        return
    scans = f", {quality['scans']:.0f} scans" if quality.get("scans", 1) > 1 else ""
    every = f", one of every {quality['frames_every']:.0f} of the scan" if "frames_every" in quality else ""
    yield "frames used", f"{quality['frames_used']:.0f} of {quality['frames_total']:.0f}{scans}{every}"
    yield from (("  left out", text) for text in _dropped(tactile_map))
    yield "mean pressure", f"{quality['mean_pressure_kpa']:.1f} kPa"


def _dropped(tactile_map: TactileMap) -> Iterator[str]:
    """How many frames were left out for each reason."""
    quality = tactile_map.quality
    window = tactile_map.recipe.pressure_window_kpa or (np.nan, np.nan)
    yield from (f"{quality[name]:.0f} {why.format(*window)}" for name, why in _DROPPED.items() if quality.get(name))


def _making(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Timing, plane, and what the strokes tell: `_ROWS`, as far as the map has their figures."""
    quality = tactile_map.quality
    shifts = [
        f"{number}: {quality[f'stroke_{number}_shift_x_mm']:+.2f} +- {quality[f'stroke_{number}_sd_x_mm']:.2f}"
        for number in range(1, int(quality.get("strokes", 0)) + 1)
        if f"stroke_{number}_shift_x_mm" in quality
    ]
    axes = "none: no landmarks"
    if tactile_map.patient_from_plane is not None:
        repeats = quality.get("landmark_spread_mm")
        axes = "from the landmarks" + ("" if repeats is None else f", repeats within {repeats:.1f} mm")
    values = {
        **quality,
        "latency_ms": tactile_map.recipe.latency_ms,
        "fitted_to": f"{quality['plane_frames']:.0f} frames" if "plane_frames" in quality else "all frames used",
        "patient_axes": axes,
        "shifts": ", ".join(shifts),
        "span_mm": SPAN_MM,
        "flat_field_percent": 100 * quality.get("flat_field_sd", np.nan),
    }
    rows: list[tuple[str, str]] = []
    for line in _ROWS.strip("\n").splitlines():
        name, figure, text = line.split("|")
        if figure.strip() in quality:
            first, before = rows.pop() if name == "+ " else (name.rstrip(), "")
            rows.append((first, before + text.removeprefix(" ").format_map(values)))
    yield from rows


def _cells(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Coverage, error correlation within a frame, and what the cells resolve."""
    quality = tactile_map.quality
    if "coverage" in quality:
        covered = f"{100 * quality['coverage']:.0f} % of the cells"
        yield "coverage", f"{covered}, {quality['median_count']:.0f} readings a cell"
    if "effective_readings" in quality:
        share = f"under {100 * LEAST_SHARE:.0f} %"
        if quality["shared_share"] >= LEAST_SHARE:
            share = f"{100 * quality['shared_share']:.0f} %"
        length = f", over {quality['shared_length_mm']:.1f} mm" if "shared_length_mm" in quality else ""
        readings = f"{quality['median_count']:.0f} readings a cell"
        worth = f"{readings} are worth {quality['effective_readings']:.0f} independent ones"
        yield "shared errors", f"{share} of a reading's variance is its neighbours' in the frame too{length}; {worth}"
    elif "median_count" in quality:
        yield "shared errors", "not known: too few frames that cross each other's cells, or readings without scatter"
    yield "resolves", f"lumps of map width sigma {tactile_map.recipe.cell_mm / CELL_PER_SIGMA:.2g} mm or more"
    advice = advise_cell(tactile_map)
    if advice is not None:
        yield "cell", advice.text()
    if tactile_map.recipe.normalise == "gain":
        yield "gain solve", f"{quality['gain_passes']:.0f} passes, last change {quality['gain_last_change']:.1e}"


def _notes(tactile_map: TactileMap) -> Iterator[str]:
    """Notes for the reader of the map, one line each."""
    quality = tactile_map.quality
    if tactile_map.masked_taxels:
        shown = "; ".join(tactile_map.masked_taxels[:_LISTED_TAXELS])
        more = len(tactile_map.masked_taxels) - _LISTED_TAXELS
        yield f"taxels left out: {shown}{f'; and {more} more' if more > 0 else ''}"
    if quality.get("few_cells"):
        yield f"{quality['few_cells']:.0f} cells have fewer than {FEW_READINGS} readings: noisy, mostly at the rim"
    if quality.get("negative_readings"):
        yield f"{quality['negative_readings']:.0f} readings below 0 kPa were kept as they are"
    yield from _advice(quality)


def _advice(quality: Mapping[str, float]) -> Iterator[str]:
    """What could be done better, or would bend a size."""
    gated = quality.get("dropped_low", 0.0) + quality.get("dropped_high", 0.0)
    if gated > _MUCH_GATED * quality.get("frames_total", np.inf):
        ends = f"{quality['level_p05_kpa']:.1f} to {quality['level_p95_kpa']:.1f} kPa"
        yield f"a window of {ends} would keep nine frames in ten; it lets in pressures the head was not shaped for"
    if text := skewed(quality):
        yield text
