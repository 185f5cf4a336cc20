"""A scan in a few lines, and a map in words and as a picture."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from tactile_bayes.errors import BadDataError
from tactile_bayes.findings import Finding, finding_lines, first_of, verdict
from tactile_bayes.geometry import FloatArray
from tactile_bayes.mapping.accumulate import LEAST_SHARE
from tactile_bayes.mapping.map import FEW_READINGS, Orientation, TactileMap, advise_cell, orientation_of, skewed
from tactile_bayes.mapping.plausibility import WHY_NOT
from tactile_bayes.mapping.profile import SPAN_MM
from tactile_bayes.mapping.select import CONTACT_KPA, intervals, missing_records
from tactile_bayes.presets import CELL_PER_SIGMA, RESEARCH_USE
from tactile_bayes.report.figure_file import Axes, Figure, figure_file, load_matplotlib
from tactile_bayes.scans import Scan

if TYPE_CHECKING:
    from tactile_bayes.files.reports import EstimateReport, MassReport, PassedOver


# --- A scan in a few lines.


def describe_scan(scan: Scan) -> list[str]:
    """Summary of a scan in a few lines."""
    times, poses = scan.frames.time_s, scan.poses
    span = float(times[-1] - times[0]) if len(times) else 0.0
    saturated = int((scan.frames.counts >= scan.element_calibration.saturation_count).sum())
    duplicates = int((np.diff(poses.time_s) == 0).sum())
    marks = [] if scan.landmarks is None else [name.replace("_", " ") for name in scan.landmarks.points()]
    return [
        f"{len(times)} frames of {scan.head.shape[0]} x {scan.head.shape[1]} taxels in {span:.3f} s, {_rate(times)}",
        f"{len(poses)} poses, {_rate(poses.time_s)}",
        f"dropped frames {missing_records(times)}, dropped poses {missing_records(poses.time_s)}, "
        f"duplicate pose stamps {duplicates}, saturated readings {saturated}",
        f"landmarks: {' and '.join(', '.join(marks).rsplit(', ', 1)) or 'not touched'}",
    ]


def _rate(times: FloatArray) -> str:
    steps, usual = intervals([times])
    return f"{1 / usual:.1f} Hz" if len(steps) else "no rate"


# --- Text report of a tactile map: its verdict in a few lines, or a table with units, then what was left out.

# Leaving out more frames than this share for their pressure is worth a word about the window.
_MUCH_GATED = 0.2
_MOSTLY = 0.8  #: Share of these above which they were pressed too hard, or too lightly.
_UNITS = {
    "mean": "times the mean of their frames (normalise mean)",
    "gain": "times the level beside a lump (normalise gain)",
}
_DROPPED = WHY_NOT | {"dropped_low": "pressed below {0:g} kPa", "dropped_high": "pressed above {1:g} kPa"}
# Rows of the full report: a name, the figure without which there is none, and the text; after "+" what is added to it.
_ROWS: Final = """
map | cell_mm | {size} (across x along the head), cells of {cell_mm:g} mm
values | least | {least:.3g} to {most:.3g} {units}
frames used | frames | {frames}
+ | scans_used | , {scans_used}
+ | every | , {every}
  left out | dropped | {dropped}
mean pressure | frames | {mean_pressure_kpa:.1f} kPa
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
coverage | coverage | {covered_percent:.0f} % of the cells, {median_count:.0f} readings a cell
shared errors | effective_readings | {shared} of a reading's variance is its neighbours' in the frame too{over};
+ | effective_readings |  {median_count:.0f} readings a cell are worth {effective_readings:.0f} independent ones
shared errors | unshared | not known: too few frames that cross each other's cells, or readings without scatter
resolves | cell_mm | lumps of map width sigma {resolved_mm:.2g} mm or more
cell | advice | {advice}
gain solve | gain_passes | {gain_passes:.0f} passes, last change {gain_last_change:.1e}
"""


def map_summary(tactile_map: TactileMap, *, written: str) -> str:
    """Short report of a map: its verdict with the figures that lead to it, and the names of the files written."""
    findings, facts = tactile_map.findings, _map_facts(tactile_map)
    lines = [
        *finding_lines(findings, "caution"),
        _verdict_line(findings, facts),
        *([f"left out: {'; '.join(facts['dropped'].splitlines())}"] if "dropped" in facts else []),
        f"written: {written}, {facts['size']} in cells of {facts['cell_mm']:g} mm",
        *finding_lines(findings, "check"),
        *_advice(tactile_map.quality),
        "More (timing, plane, pressure, noise): map -v.",
    ]
    return "\n".join([*lines, RESEARCH_USE]) + "\n"


def _verdict_line(findings: Sequence[Finding], facts: Mapping[str, Any]) -> str:
    figures = [f"{facts['frames']} frames"] if "frames" in facts else []
    figures += [facts[name] for name in ("scans_used", "every") if name in facts]
    if "coverage" in facts:
        figures.append(f"{facts['covered_percent']:.0f} % covered")
    if "stroke_lag_mm" in facts:
        figures.append("stroke lag {stroke_lag_mm:+.2f} +- {stroke_lag_sd_mm:.2f} mm".format_map(facts))
    return f"{verdict(findings, answered=True)}: {', '.join(figures)}"


def map_text(tactile_map: TactileMap) -> str:
    """Full report of a map: cautions and verdict, a table, what is to be checked, notes and the research-use line."""
    findings, facts, rows = tactile_map.findings, _map_facts(tactile_map), list[tuple[str, str]]()
    if (advice := advise_cell(tactile_map)) is not None:
        facts["advice"] = advice.text()
    for line in _ROWS.strip("\n").splitlines():
        name, figure, text = line.split("|")
        if figure.strip() in facts:
            first, before = rows.pop() if name == "+ " else (name.rstrip(), "")
            rows.append((first, before + text.removeprefix(" ").format_map(facts)))
    width = max(len(name) for name, _ in rows)
    lines = [f"{name.ljust(width)}  {part}" for name, text in rows for part in text.splitlines()]
    head = [*finding_lines(findings, "caution"), _verdict_line(findings, facts), ""]
    checks = finding_lines(findings, "check")
    return "\n".join([*head, *lines, "", *checks, *_notes(tactile_map), RESEARCH_USE]) + "\n"


def _map_facts(tactile_map: TactileMap) -> dict[str, Any]:
    """Known figures of a map, and words on them, by name."""
    quality, recipe, values = tactile_map.quality, tactile_map.recipe, tactile_map.mean[tactile_map.covered]
    rows, columns = tactile_map.mean.shape
    facts: dict[str, Any] = {
        **quality,
        "cell_mm": recipe.cell_mm,
        "size": f"{columns * recipe.cell_mm:g} x {rows * recipe.cell_mm:g} mm",
        "latency_ms": recipe.latency_ms,
        "fitted_to": f"{quality['plane_frames']:.0f} frames" if "plane_frames" in quality else "all frames used",
        "patient_axes": "none: no landmarks",
        "span_mm": SPAN_MM,
        "flat_field_percent": 100 * quality.get("flat_field_sd", np.nan),
        "covered_percent": 100 * quality.get("coverage", np.nan),
        "resolved_mm": recipe.cell_mm / CELL_PER_SIGMA,
        "over": f", over {quality['shared_length_mm']:.1f} mm" if "shared_length_mm" in quality else "",
    }
    if values.size:
        units = _UNITS.get(recipe.normalise, f"{recipe.value_unit or 'of unknown unit'} (normalise none)")
        facts |= {"least": values.min(), "most": values.max(), "units": units}
    if "frames_total" in quality:
        facts["frames"] = "{frames_used:.0f} of {frames_total:.0f}".format_map(quality)
        if quality.get("scans", 1) > 1:
            facts["scans_used"] = f"{quality['scans']:.0f} scans"
        if "frames_every" in quality:
            facts["every"] = f"one of every {quality['frames_every']:.0f} of the scan"
    window = recipe.pressure_window_kpa or (np.nan, np.nan)
    out = [f"{quality[name]:.0f} {why.format(*window)}" for name, why in _DROPPED.items() if quality.get(name)]
    if out:
        facts["dropped"] = "\n".join(out)
    if tactile_map.patient_from_plane is not None:
        repeats = quality.get("landmark_spread_mm")
        facts["patient_axes"] = "from the landmarks" + ("" if repeats is None else f", repeats within {repeats:.1f} mm")
    facts["shifts"] = ", ".join(
        f"{number}: {quality[f'stroke_{number}_shift_x_mm']:+.2f} +- {quality[f'stroke_{number}_sd_x_mm']:.2f}"
        for number in range(1, int(quality.get("strokes", 0)) + 1)
        if f"stroke_{number}_shift_x_mm" in quality
    )
    if "effective_readings" in quality:
        known, least = quality["shared_share"] >= LEAST_SHARE, f"under {100 * LEAST_SHARE:.0f} %"
        facts["shared"] = f"{100 * quality['shared_share']:.0f} %" if known else least
    elif "median_count" in quality:
        facts["unshared"] = True
    return facts


def _notes(tactile_map: TactileMap) -> Iterator[str]:
    quality = tactile_map.quality
    if tactile_map.masked_taxels:
        yield f"taxels left out: {first_of(tactile_map.masked_taxels, 8, '; ')}"
    if quality.get("few_cells"):
        yield f"{quality['few_cells']:.0f} cells have fewer than {FEW_READINGS} readings: noisy, mostly at the rim"
    if quality.get("negative_readings"):
        yield f"{quality['negative_readings']:.0f} readings below 0 kPa were kept as they are"
    yield from _advice(quality)


def _advice(quality: Mapping[str, float]) -> Iterator[str]:
    """Advice on the pressure window and on skewed strokes."""
    gated = quality.get("dropped_low", 0.0) + quality.get("dropped_high", 0.0)
    many = gated > _MUCH_GATED * quality.get("frames_total", np.inf)
    if many and quality["level_p05_kpa"] < CONTACT_KPA:
        yield "the head was lifted: keep it on the skin"
    elif many:
        ends = f"{quality['level_p05_kpa']:.1f} to {quality['level_p95_kpa']:.1f} kPa"
        high = quality.get("dropped_high", 0.0) / gated
        press = "less hard" if high > _MOSTLY else "harder" if high < 1 - _MOSTLY else "more evenly"
        window = f"a window of {ends} (--pressure-window-kpa) would keep nine frames in ten"
        yield f"press {press} next time; {window}, but lets in pressures the head was not shaped for"
    if text := skewed(quality):
        yield text


_SCALE_BAR_MM = 10.0
_HATCHES = 60  #: Lines of hatching across the longer side of the map.
# The colours span at least this share of the level below and above it, so that noise alone does not look like a lump.
_LEAST_COLOURS = (0.9, 1.3)
# With a fit they end so many amplitudes above the level, so that a rib beside the lump does not take them all.
AMPLITUDES_SHOWN = 1.25
_AXIS_WORDS: Final = {"x": "across the head, x (mm)", "y": "along the head, y (mm)"}
# Words above a mark, so many points away.
_ABOVE: Final[dict[str, Any]] = {
    "textcoords": "offset points",
    "ha": "center",
    "va": "bottom",
    "color": "white",
    "fontsize": 8,
}
# Of a legend below a picture, where it hides no cell.
_BELOW: Final[dict[str, Any]] = {"loc": "upper left", "bbox_to_anchor": (0.0, 0.0), "borderaxespad": 4.0}
_MOST_IN: Final = (10.0, 9.0)  #: Width of a figure and its height at most: it ends where its panels do.
_EXPLAINED_PLACES: Final = 4  #: Places that were looked at in vain: so many are explained, the others are only marked.


def map_figure(
    tactile_map: TactileMap,
    path: Path | None,
    *,
    report: EstimateReport | None = None,
    title: str = "",
    note: str = "",
    findings: Sequence[Finding] | None = None,
    force: bool = False,
) -> Figure:
    """Draw a map in mm beside its coverage, and write it as PNG, PDF or SVG by the suffix.

    It is shown as `orientation_of` says, with the patient's sides or the plane's axes named at its edges. Cells with
    fewer than `FEW_READINGS` readings are hatched in both panels, where the readings of cells are known.

    Of the `report` of its estimate the lump is drawn as an ellipse of its size, and dashed as one of the fitted bump's
    sigmas; masses are numbered where there are several, and those besides the lump get an ellipse of their size. Places
    looked at in vain are numbered crosses, the first few with their reasons below the coverage. The title, which
    identifies nobody, and `findings`, by default the report's or the map's own, stand above the map; a `note`, for
    example why there is no estimate, above the whole figure.
    """
    if not tactile_map.covered.any():
        raise BadDataError("the map holds no data to draw", way_out="make it from a scan with frames in the window")
    view = orientation_of(tactile_map)
    shown_findings = (tactile_map if report is None else report).findings if findings is None else findings
    looked_at = [] if report is None else [candidate for candidate in report.candidates if candidate.fault]
    foot = _caption(tactile_map, view)
    with figure_file(path, size_in=_MOST_IN, trim=True, foot=foot, force=force, findings=shown_findings) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.55, 1.0))
        _draw_values(left, tactile_map, view, report)
        _draw_coverage(right, tactile_map, view)
        for axes in (left, right):
            _hatch_few(axes, tactile_map, view)
            _orient(axes, view, tactile_map)
        if report is not None:
            _draw_fit(left, report, view)
            _draw_masses(left, report, view)
        _draw_scale_bar(left)
        draw_edges(left, view)
        _draw_notch(left, view)
        _draw_places(left, looked_at, view)
        _explain(right, tactile_map, looked_at)
        left.set_title(title or "Tactile map", loc="left", fontsize=11)
        if note:
            figure.suptitle(textwrap.fill(note, 130), x=0.01, ha="left", fontsize=9.5)
    return figure


def _across_up(view: Orientation, x: Any, y: Any) -> tuple[Any, Any]:
    return (y, x) if view.swapped else (x, y)


def _extent(tactile_map: TactileMap, view: Orientation) -> tuple[float, float, float, float]:
    """Ends of the horizontal and vertical axes, including the outer halves of the cells."""
    half = tactile_map.recipe.cell_mm / 2
    across, up = _across_up(view, tactile_map.x_mm, tactile_map.y_mm)
    return (float(across[0]) - half, float(across[-1]) + half, float(up[0]) - half, float(up[-1]) + half)


def draw_cells(axes: Axes, values: Any, extent: Any, **looks: Any) -> Any:
    """Draw values as an image between the ends of its axes; masked cells stay grey."""
    axes.set_facecolor("0.85")
    return axes.imshow(values, origin="lower", extent=extent, interpolation="nearest", **looks)


def _draw_map(axes: Axes, values: Any, tactile_map: TactileMap, view: Orientation, **looks: Any) -> Any:
    return draw_cells(axes, values.T if view.swapped else values, _extent(tactile_map, view), **looks)


def draw_panel(axes: Axes, values: Any, tactile_map: TactileMap, *, label: str, title: str, **looks: Any) -> None:
    """Draw cells in the map's orientation, with its sides and a colour bar; NaN stays grey."""
    view = orientation_of(tactile_map)
    image = _draw_map(axes, np.ma.masked_invalid(values), tactile_map, view, **looks)
    _colour_bar(axes, image, label)
    _orient(axes, view, tactile_map)
    draw_edges(axes, view)
    axes.set_title(title, loc="left", fontsize=11)


def _draw_values(axes: Axes, tactile_map: TactileMap, view: Orientation, report: EstimateReport | None) -> None:
    well = tactile_map.covered & (~tactile_map.few)  # one noisy edge cell would hide the lump
    values = tactile_map.mean[well if well.any() else tactile_map.covered]
    level = float(np.median(values))
    lowest = min(float(values.min()), _LEAST_COLOURS[0] * level)
    highest = max(float(values.max()), _LEAST_COLOURS[1] * level)
    top = highest
    if report is not None and report.background is not None and report.amplitude is not None:
        level = report.background.median
        top = min(highest, max(_LEAST_COLOURS[1] * level, level + AMPLITUDES_SHOWN * report.amplitude.median))
    cells = np.ma.masked_where(~tactile_map.covered, tactile_map.mean)
    image = _draw_map(axes, cells, tactile_map, view, cmap="viridis", vmin=lowest, vmax=top)
    _colour_bar(axes, image, tactile_map.recipe.value_words, extend="max" if top < highest else "neither")


def _draw_coverage(axes: Axes, tactile_map: TactileMap, view: Orientation) -> None:
    image = _draw_map(axes, np.ma.masked_equal(tactile_map.count, 0), tactile_map, view, cmap="cividis", vmin=0)
    known = tactile_map.counts_known
    if known:
        _colour_bar(axes, image, "readings per cell")
    axes.set_title("Coverage" + ("" if known else " (readings per cell unknown)"), loc="left", fontsize=11)


def _hatch_few(axes: Axes, tactile_map: TactileMap, view: Orientation) -> None:
    """Hatch the cells with few readings in white with black edges, visible on every colour."""
    if not tactile_map.few.any():
        return
    outline = load_matplotlib().path.Path
    half = tactile_map.recipe.cell_mm / 2
    rows, columns = np.nonzero(tactile_map.few)
    middle = np.stack(_across_up(view, tactile_map.x_mm[columns], tactile_map.y_mm[rows]), axis=1)
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    codes = [outline.MOVETO, outline.LINETO, outline.LINETO, outline.LINETO, outline.CLOSEPOLY]
    cells = outline((middle[:, None] + corners).reshape(-1, 2), np.tile(codes, len(middle)))
    left, right, bottom, top = _extent(tactile_map, view)
    height = top - bottom
    starts = np.arange(left - height, right, max(right - left, height) / _HATCHES)
    slants = [[(start, bottom), (start + height, top)] for start in starts]
    looks: dict[str, Any] = {"colors": "white", "linewidths": 0.7, "path_effects": _outlined(1.6)}
    lines = load_matplotlib().collections.LineCollection(slants, **looks)
    axes.add_collection(lines, autolim=False)
    lines.set_clip_path(cells, axes.transData)


def _explain(axes: Axes, tactile_map: TactileMap, places: Sequence[PassedOver]) -> None:
    """Explain hatching and places below the coverage panel, where no cell is hidden."""
    lines = [f"{i}  ({one.x_mm:.0f}, {one.y_mm:.0f}) mm: {one.fault}" for i, one in enumerate(places, start=1)]
    wrapped = [textwrap.wrap(line, 66, subsequent_indent="    ", max_lines=2) for line in lines[:_EXPLAINED_PLACES]]
    shown = ["\n".join(line) for line in wrapped]
    if len(lines) > len(shown):
        shown.append(f"and {len(lines) - len(shown)} lower ones")
    if shown:
        below_the_legend: dict[str, Any] = {"xytext": (0, -54), "textcoords": "offset points", "va": "top"}
        axes.annotate("\n".join(shown), (0.0, 0.0), xycoords="axes fraction", fontsize=7, **below_the_legend)
    if not tactile_map.few.any():
        return
    sample = load_matplotlib().patches.Patch(facecolor="0.35", edgecolor="white", hatch="////", linewidth=0)
    axes.legend([sample], [f"fewer than {FEW_READINGS} readings: noisy"], fontsize=8, frameon=False, **_BELOW)


def _colour_bar(axes: Axes, image: Any, label: str, *, extend: Any = "neither") -> None:
    bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.02, 0.0, 0.035, 1.0)), extend=extend)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _orient(axes: Axes, view: Orientation, tactile_map: TactileMap) -> None:
    axes.set_anchor("N")
    words = _AXIS_WORDS if tactile_map.recipe.source == "scan" else {"x": "x (mm)", "y": "y (mm)"}
    back = {view.right: "larger to the left", view.up: "larger downwards"}
    across, up = (
        words[axis[1]] if axis[0] == "+" else f"{words[axis[1]].removesuffix(')')}, {direction})"
        for axis, direction in back.items()
    )
    axes.set_xlabel(across, fontsize=9)
    axes.set_ylabel(up.replace(" (mm, ", "\n(mm, "), fontsize=9)  # in one line it is longer than the coverage is high
    axes.tick_params(labelsize=8)
    if view.right[0] == "-":
        axes.invert_xaxis()
    if view.up[0] == "-":
        axes.invert_yaxis()


def _outlined(width: float) -> list[Any]:
    """Black outline, so that white is visible on every colour."""
    return [load_matplotlib().patheffects.withStroke(linewidth=width, foreground="black")]


def draw_edges(axes: Axes, view: Orientation) -> None:
    """Label the edges: the patient's R, L, H (head) and F (feet), or else axes."""
    places = {"left": (0.015, 0.5), "right": (0.985, 0.5), "top": (0.5, 0.975), "bottom": (0.5, 0.025)}
    aligned = {"left": ("left", "center"), "right": ("right", "center"), "top": ("center", "top")}
    for side, name in view.edges.items():
        across, up = aligned.get(side, ("center", "bottom"))
        looks: dict[str, Any] = {"ha": across, "va": up, "color": "white", "fontsize": 10}
        axes.text(*places[side], name, transform=axes.transAxes, path_effects=_outlined(2.5), **looks)


def ellipse_of(report: EstimateReport | MassReport) -> tuple[tuple[float, float] | None, float]:
    """Diameters of a mass along its own axes, mm, None without a size, and the angle in degrees from x to the first."""
    along, across = report.d_x_mm, report.d_y_mm
    axes = None if along is None or across is None else (along.median, across.median)
    return axes, 0.0 if report.angle_deg is None else report.angle_deg.median


def _draw_fit(axes: Axes, report: EstimateReport, view: Orientation) -> None:
    """Draw the lump's size where there is one, and the fitted bump, which is wider than the lump, dashed."""
    place, across, along = report.centre_mm, report.sigma_x_mm, report.sigma_y_mm
    if place is None or across is None or along is None:
        return
    ellipses = [((2 * across.median, 2 * along.median), "--", 1.2, "fitted bump, 1 sigma (not the lump's edge)")]
    axes_mm, angle_deg = ellipse_of(report)
    if axes_mm is not None:
        ellipses.insert(0, (axes_mm, "-", 1.8, "size, median {:.1f} by {:.1f} mm".format(*axes_mm)))
    centre = _across_up(view, *place.median)
    for size_mm, dash, width, label in ellipses:
        _draw_ellipse(axes, centre, size_mm, angle_deg, view, linewidth=width, linestyle=dash, label=label)
    axes.plot(*centre, "+", color="white", markersize=9, markeredgewidth=1.6, path_effects=_outlined(3.2))
    axes.legend(fontsize=8, facecolor="0.4", labelcolor="white", **_BELOW)


def _draw_ellipse(
    axes: Axes, centre: Any, size_mm: tuple[float, float], angle_deg: float, view: Orientation, **line: Any
) -> None:
    angle = -angle_deg if view.swapped else angle_deg
    ellipse = load_matplotlib().patches.Ellipse(
        centre, *_across_up(view, *size_mm), angle=angle, fill=False, edgecolor="white", **line
    )
    ellipse.set_path_effects(_outlined(line["linewidth"] + 1.6))
    axes.add_patch(ellipse)


def _draw_masses(axes: Axes, report: EstimateReport, view: Orientation) -> None:
    """Draw the number of each of several masses, and a cross and the size of those besides the fitted lump."""
    for mass in report.masses if len(report.masses) > 1 else ():
        centre, (size_mm, angle_deg) = _across_up(view, *mass.centre_mm.median), ellipse_of(mass)
        above = max(size_mm or (0.0, 0.0)) / 2.0
        top = centre[1] + (above if axes.get_ylim()[1] > axes.get_ylim()[0] else -above)
        axes.annotate(f"mass {mass.number}", (centre[0], top), xytext=(0, 4), path_effects=_outlined(2.5), **_ABOVE)
        if report.centre_mm is not None and mass.reported:
            continue
        axes.plot(*centre, "+", color="white", markersize=7, markeredgewidth=1.4, path_effects=_outlined(3.0))
        if size_mm is not None:
            _draw_ellipse(axes, centre, size_mm, angle_deg, view, linewidth=1.0)


def _draw_places(axes: Axes, places: Sequence[PassedOver], view: Orientation) -> None:
    for number, place in enumerate(places, start=1):
        point = _across_up(view, place.x_mm, place.y_mm)
        axes.plot(*point, "x", color="white", markersize=6, markeredgewidth=1.4, path_effects=_outlined(3.0))
        if number <= _EXPLAINED_PLACES:
            beside = _ABOVE | {"ha": "left", "va": "center", "fontsize": 9, "path_effects": _outlined(2.5)}
            axes.annotate(f"{number}", point, xytext=(6, 0), **beside)


def _draw_scale_bar(axes: Axes) -> None:
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    sign = 1.0 if right > left else -1.0
    start = left + 0.05 * (right - left)
    height = bottom + 0.06 * (top - bottom)
    ends = [start, start + sign * _SCALE_BAR_MM]
    axes.plot(ends, [height, height], color="white", linewidth=3, path_effects=_outlined(4))
    middle = (start + sign * _SCALE_BAR_MM / 2, height)
    axes.annotate(f"{_SCALE_BAR_MM:g} mm", middle, xytext=(0, 4), path_effects=_outlined(2), **_ABOVE)


def _draw_notch(axes: Axes, view: Orientation) -> None:
    if view.notch is None:
        return
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    tail, length = (0.86, 0.08), 0.16
    across, up = view.notch
    tip = (tail[0] + length * across * abs((top - bottom) / (right - left)), tail[1] + length * up)
    arrow = {"arrowstyle": "-|>", "color": "white", "linewidth": 1.8, "path_effects": _outlined(3)}
    axes.annotate("", tip, tail, xycoords="axes fraction", arrowprops=arrow)
    words: dict[str, Any] = {"xycoords": "axes fraction", "path_effects": _outlined(2)} | _ABOVE
    axes.annotate("to sternal\nnotch", tip, xytext=(0, 3), **words)


def _caption(tactile_map: TactileMap, view: Orientation) -> str:
    recipe = tactile_map.recipe
    facts = [f"cells {recipe.cell_mm:g} mm", f"normalise {recipe.normalise}"]
    if recipe.pressure_window_kpa:
        facts.append("window {:g} to {:g} kPa".format(*recipe.pressure_window_kpa))
    if tactile_map.frame_count:
        facts.append(f"{tactile_map.frame_count} frames")
    return f"{view.words}.  {', '.join(facts)}."
