"""A tactile map as text for people: one table with units, then what was left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tactile_bayes.mapping.tactile_map import TactileMap
from tactile_bayes.presets import CELL_PER_SIGMA, RESEARCH_USE

# A strip of the plane narrower than the head itself shows no lump's flanks.
_LOW_COVERAGE = 0.5
_HIGH_TILT_DEG = 10.0
_HIGH_YAW_DEG = 15.0
_LISTED_TAXELS = 8
_UNITS = {
    "mean": "times the mean of their frames (normalise mean)",
    "gain": "times the level beside a lump (normalise gain)",
    "none": "kPa (normalise none)",
}
_DROPPED = (
    ("dropped_low", "mean pressure below the window"),
    ("dropped_high", "mean pressure above the window"),
    ("dropped_no_pose", "without a tracker pose"),
    ("dropped_elements", "with too few valid taxels"),
)


def map_text(tactile_map: TactileMap, *, lost: Sequence[str] = ()) -> str:
    """The whole report; the research-use line comes last.

    Parameters
    ----------
    lost
        What the scan files had lost before they were read, one line each.
    """
    rows = [*_what(tactile_map), *_frames(tactile_map), *_plane(tactile_map), *_cells(tactile_map)]
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {text}" for name, text in rows]
    return "\n".join([*lines, "", *lost, *_notes(tactile_map), RESEARCH_USE]) + "\n"


def _what(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Size of the map and the range of its values."""
    rows, columns = tactile_map.mean.shape
    cell = tactile_map.recipe.cell_mm
    yield "map", f"{columns * cell:g} x {rows * cell:g} mm (across x along the head), cells of {cell:g} mm"
    values = tactile_map.mean[tactile_map.covered]
    if values.size:
        yield "values", f"{values.min():.3g} to {values.max():.3g} {_UNITS[tactile_map.recipe.normalise]}"


def _frames(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """Frames used and left out, each with its reason."""
    quality = tactile_map.quality
    if "frames_total" not in quality:
        return
    scans = f", {quality['scans']:.0f} scans" if quality.get("scans", 1) > 1 else ""
    yield "frames used", f"{quality['frames_used']:.0f} of {quality['frames_total']:.0f}{scans}"
    window = tactile_map.recipe.pressure_window_kpa
    for name, reason in _DROPPED:
        if quality.get(name):
            limits = f" of {window[0]:g} to {window[1]:g} kPa" if window and "window" in reason else ""
            yield "  left out", f"{quality[name]:.0f} {reason}{limits}"
    yield "mean pressure", f"{quality['mean_pressure_kpa']:.1f} kPa"


def _plane(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    """How well the motion lies on a plane, and how the head was held."""
    quality = tactile_map.quality
    if "plane_rms_mm" not in quality:
        return
    yield "plane", f"rms {quality['plane_rms_mm']:.1f} mm, {quality['tilt_deg']:.1f} deg from the head's face"
    moved = f"{quality['span_x_mm']:.0f} x {quality['span_y_mm']:.0f} mm"
    yield "head", f"turned by {quality['yaw_sd_deg']:.1f} deg (SD), moved {moved}"
    yield "patient axes", "from the landmarks" if tactile_map.patient_from_plane is not None else "none: no landmarks"


def _cells(tactile_map: TactileMap) -> Iterator[tuple[str, str]]:
    quality = tactile_map.quality
    if "coverage" in quality:
        yield (
            "coverage",
            f"{100 * quality['coverage']:.0f} % of the cells, {quality['median_count']:.0f} readings a cell",
        )
    yield "resolves", f"lumps of map width sigma {tactile_map.recipe.cell_mm / CELL_PER_SIGMA:.2g} mm or more"
    if tactile_map.recipe.normalise == "gain":
        yield "gain solve", f"{quality['gain_passes']:.0f} passes, last change {quality['gain_last_change']:.1e}"


def _notes(tactile_map: TactileMap) -> Iterator[str]:
    """What the reader of the map should know, one line each."""
    quality = tactile_map.quality
    if tactile_map.masked_taxels:
        shown = "; ".join(tactile_map.masked_taxels[:_LISTED_TAXELS])
        more = len(tactile_map.masked_taxels) - _LISTED_TAXELS
        yield f"taxels left out: {shown}{f'; and {more} more' if more > 0 else ''}"
    if quality.get("saturated_readings"):
        yield f"{quality['saturated_readings']:.0f} readings at full scale left out: the map is too low there"
    if quality.get("clipped_values"):
        yield f"{quality['clipped_values']:.0f} values beyond the map's range were clipped"
    if quality.get("gain_unsettled"):
        yield "the gain solve stopped before it settled: use --normalise mean, or scan with overlapping strokes"
    if quality.get("coverage", 1.0) < _LOW_COVERAGE:
        yield "coverage is low: add strokes side by side, or use larger cells"
    if quality.get("tilt_deg", 0.0) > _HIGH_TILT_DEG:
        yield "the head's face was tilted against its motion: check the lever arm of the tracker"
    if quality.get("yaw_sd_deg", 0.0) > _HIGH_YAW_DEG:
        yield "the head was turned while scanning: widths across and along it are mixed"
