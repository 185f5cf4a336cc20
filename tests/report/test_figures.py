"""Pictures: written whole, the same bytes each time, drawn as the examiner sees the breast."""

from __future__ import annotations

import stat
import struct
from pathlib import Path

import numpy as np
import pytest
from plain_reports import estimate_report

import tactile_bayes as tb
from tactile_bayes.declarations import replace
from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.files.reports import PassedOver, Point
from tactile_bayes.geometry import rigid
from tactile_bayes.inference.draws import Quantity
from tactile_bayes.mapping.map import MapRecipe, TactileMap
from tactile_bayes.report import estimate_figures as sizes
from tactile_bayes.report import map as maps
from tactile_bayes.report.estimate_figures import corner_figure, draw_size
from tactile_bayes.report.map import map_figure


def quantity(median: float) -> Quantity:
    ends = {"low": median - 3.0, "high": median + 3.0}
    return Quantity(median=median, mean=median, sd=1.5, **ends, probability=0.95, kind="eti")


INTERVALS = {"max_size_mm": quantity(15.0), "min_size_mm": quantity(12.0)}
FIT = estimate_report(
    centre_mm=Point(quantity(3.0), quantity(-2.0)),
    sigma_x_mm=quantity(6.0),
    sigma_y_mm=quantity(4.0),
    angle_deg=quantity(20.0),
    background=quantity(1.0),
)


class Sizes:
    """Draws of both sizes, whose intervals are known."""

    another_exam = None

    def __init__(self, largest: np.ndarray, smallest: np.ndarray) -> None:
        self.max_size_mm, self.min_size_mm = largest, smallest
        self.leading = self

    def summarise(self, name: str, *, probability: float) -> Quantity:
        return replace(INTERVALS[name], probability=probability)


def size_figure(largest: np.ndarray, smallest: np.ndarray, path: Path | None):
    return draw_size(Sizes(largest, smallest), path, name="s01", probability=0.95, findings=(), force=False)


def densities(axes) -> list:
    return [line for line in axes.lines if len(line.get_xdata()) > 2]


def bump_map(*, normalise: str = "mean") -> TactileMap:
    x, y = np.arange(-20.0, 21.0), np.arange(-15.0, 16.0)
    mean = 1 + 0.5 * np.exp(-((x - 3) ** 2 / 72 + (y[:, None] + 2) ** 2 / 32))
    count = np.full(mean.shape, 50)
    count[:3, :4] = 0
    mean = np.where(count > 0, mean, np.nan)
    recipe = MapRecipe("scan", normalise, 1.0, (5.0, 14.0))
    return TactileMap(mean, mean * 0.01, count, x, y, recipe, plane_from_base=np.eye(4), frame_count=900)


def draws(seed: int, centre: float) -> np.ndarray:
    return np.random.default_rng(seed).normal(centre, 1.5, 2000)


def integral(y: np.ndarray, x: np.ndarray) -> float:
    return float(y.sum() * (x[1] - x[0]))


def png_size(path: Path) -> tuple[int, int]:
    head = path.read_bytes()[:24]
    assert head.startswith(b"\x89PNG\r\n\x1a\n")
    return struct.unpack(">II", head[16:24])


def _keeping(draw, kept: list):
    def keep(axes, *more, **how):
        draw(axes, *more, **how)
        kept.append(axes)

    return keep


@pytest.fixture
def axes(monkeypatch):
    """The figure that was written last, for looking at what is on it."""
    kept = []
    for module, name in ((sizes, "_draw_interval"), (maps, "_draw_values")):
        monkeypatch.setattr(module, name, _keeping(getattr(module, name), kept))
    return kept


@pytest.mark.long
@pytest.mark.parametrize(("fit", "normalise"), [(None, "mean"), (FIT, "gain"), (None, "none")])
def test_a_map_is_drawn_in_the_same_bytes_each_time(tmp_path, fit, normalise):
    for name in ("a.png", "b.png"):
        map_figure(bump_map(normalise=normalise), tmp_path / name, report=fit, title="Map 1")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert b"Matplotlib" not in (tmp_path / "a.png").read_bytes()
    assert png_size(tmp_path / "a.png")[0] == 1500
    assert stat.S_IMODE((tmp_path / "a.png").stat().st_mode) == 0o600


@pytest.mark.long_repeats
@pytest.mark.parametrize("shape", [(31, 41), (31, 20), (12, 41)])
@pytest.mark.parametrize("fit", [None, FIT])
@pytest.mark.parametrize("places", [0, 6])
def test_a_map_of_any_form_leaves_no_band_of_its_figure_empty(tmp_path, shape, fit, places):
    whole, (ny, nx) = bump_map(), shape
    part = {name: getattr(whole, name)[:ny, :nx] for name in ("mean", "variance", "count")}
    looked_at = [PassedOver(0.0, float(n), "no bump with a flank on every side within 20 mm") for n in range(places)]
    report = replace(fit or estimate_report(), candidates=tuple(looked_at))
    cut = replace(whole, **part, x_mm=whole.x_mm[:nx], y_mm=whole.y_mm[:ny])
    map_figure(cut, tmp_path / "map.png", report=report)
    from PIL import Image

    dark = np.asarray(Image.open(tmp_path / "map.png").convert("L")) < 250
    assert np.diff(np.flatnonzero(dark.any(axis=1))).max() < max(60, 0.11 * len(dark))


@pytest.mark.long
def test_a_users_matplotlib_settings_do_not_change_the_picture(tmp_path):
    import matplotlib

    map_figure(bump_map(), tmp_path / "a.png")
    with matplotlib.rc_context({"font.size": 30, "image.cmap": "jet", "savefig.dpi": 20}):
        map_figure(bump_map(), tmp_path / "b.png")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.long
def test_a_notebooks_backend_that_is_not_installed_here_does_not_keep_a_command_from_drawing(run_cli, tmp_path):
    scan = Path(tb.__file__).parent / "demo" / "scan.mcap"
    words = ("map", scan, "-o", "m.nc", "--figure", "m.svg")
    done = run_cli(*words, cwd=tmp_path, env={"MPLBACKEND": "module://not_installed.backend_inline"})
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "m.svg").stat().st_size > 1000


@pytest.mark.long_repeats
@pytest.mark.parametrize(
    ("notch", "x_to_the_left", "y_up"), [((0.0, 1.0), True, True), ((0.0, -1.0), False, False), (None, True, True)]
)
def test_the_viewer_looks_into_the_tissue_with_the_notch_above(axes, notch, x_to_the_left, y_up):
    to_patient = None
    if notch is not None:
        y_axis = np.array([*notch, 0.0])
        to_patient = rigid(np.stack([np.cross(y_axis, [0, 0, 1.0]), y_axis, [0, 0, 1.0]]), np.zeros(3))
    map_figure(replace(bump_map(), patient_from_plane=to_patient), None)
    assert axes[0].xaxis_inverted() == x_to_the_left
    assert axes[0].yaxis_inverted() != y_up
    # One axis turned, never both or none: two would show the breast from within.
    assert axes[0].xaxis_inverted() != axes[0].yaxis_inverted()
    assert max(map(len, axes[0].get_ylabel().splitlines())) <= 25  # the coverage beside it is as low as 70 mm


def test_an_imported_grid_is_drawn_as_its_file_reads(axes):
    map_figure(replace(bump_map(), plane_from_base=None), None)
    assert not axes[0].xaxis_inverted()
    assert axes[0].yaxis_inverted()
    map_figure(replace(bump_map(), plane_from_base=None, recipe=MapRecipe("grid", "none", 1.0)), None)
    assert axes[1].get_xlabel() == "x (mm)"


def test_the_size_is_drawn_and_one_sigma_of_the_bump_is_named_as_no_lump(axes):
    map_figure(bump_map(), None, report=replace(FIT, d_x_mm=quantity(14.0), d_y_mm=quantity(10.0)))
    ellipses = axes[0].patches
    assert [(one.width, one.height, one.angle) for one in ellipses] == [(14.0, 10.0, 20.0), (12.0, 8.0, 20.0)]
    assert {one.center for one in ellipses} == {(3.0, -2.0)}
    labels = [text.get_text() for text in axes[0].get_legend().get_texts()]
    assert labels == ["size, median 14.0 by 10.0 mm", "fitted bump, 1 sigma (not the lump's edge)"]


def test_an_ellipse_turns_with_a_plane_that_is_shown_by_a_quarter_turn(axes):
    """With the notch along x the picture has y across: the ellipse's long axis keeps its cells."""
    to_patient = rigid(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    map_figure(replace(bump_map(), patient_from_plane=to_patient), None, report=FIT)
    (ellipse,) = axes[0].patches
    assert (ellipse.center, ellipse.width, ellipse.height, ellipse.angle) == ((-2.0, 3.0), 8.0, 12.0, -20.0)
    (image,) = axes[0].images
    np.testing.assert_array_equal(np.asarray(image.get_array().filled(np.nan)), bump_map().mean.T)


@pytest.mark.long
def test_a_rib_beside_the_lump_does_not_take_all_colours(axes):
    ribbed = bump_map()
    mean = ribbed.mean.copy()
    mean[-6:] = 4.0
    map_figure(replace(ribbed, mean=mean), None, report=replace(FIT, amplitude=quantity(0.5)))
    assert axes[0].images[0].get_clim()[1] == pytest.approx(1 + 1.25 * 0.5)
    map_figure(replace(ribbed, mean=mean), None)
    assert axes[1].images[0].get_clim()[1] == 4.0


def test_places_that_were_looked_at_are_marked_with_their_reasons(axes):
    places = [PassedOver(float(i), 0.0, f"reason {i}") for i in range(6)]
    map_figure(bump_map(), None, report=estimate_report(candidates=tuple(places)), note="No estimate: nothing there.")
    crosses = [line for line in axes[0].lines if line.get_marker() == "x"]
    assert [line.get_xdata()[0] for line in crosses] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    words = "\n".join(text.get_text() for text in axes[0].figure.axes[1].texts)
    assert "4  (3, 0) mm: reason 3\nand 2 lower ones" in words
    assert axes[0].figure.get_suptitle() == "No estimate: nothing there."


def test_a_grid_without_counts_is_not_hatched_and_its_unit_is_unknown(axes):
    whole = bump_map()
    recipe = MapRecipe("grid", "none", 1.0)
    grid = replace(whole, count=(whole.count > 0).astype(int), recipe=recipe, plane_from_base=None, background=None)
    map_figure(grid, None)
    left, right, *_ = axes[0].figure.axes
    assert not hatching(left) + hatching(right)
    assert left.child_axes[0].get_ylabel() == "value (unit unknown)"
    map_figure(replace(grid, recipe=replace(recipe, units="counts")), None)
    assert axes[1].child_axes[0].get_ylabel() == "value (counts)"
    known = replace(grid, count=np.where(whole.count > 0, 3, 0))
    assert known.few.sum() == known.covered.sum()


@pytest.mark.long
@pytest.mark.parametrize(
    ("suffix", "begins"), [(".png", b"\x89PNG\r\n"), (".PDF", b"%PDF-1."), (".svg", b"<?xml version")]
)
def test_a_figure_is_what_its_suffix_says_in_the_same_bytes_each_time(tmp_path, suffix, begins):
    for name in ("a", "b"):
        map_figure(bump_map(), tmp_path / f"{name}{suffix}", report=FIT)
        size_figure(draws(0, 15), draws(1, 12), tmp_path / f"size-{name}{suffix}")
    for name in ("", "size-"):
        written = (tmp_path / f"{name}a{suffix}").read_bytes()
        assert written.startswith(begins)
        assert written == (tmp_path / f"{name}b{suffix}").read_bytes()
        assert b"Matplotlib v" not in written
        assert b"CreationDate" not in written
        assert b"<dc:date>" not in written


@pytest.mark.parametrize("name", ["map.jpg", "map", "map.png.bak"])
def test_another_suffix_is_refused(tmp_path, name):
    with pytest.raises(UsageError, match=r"(written as one of |\()\.png, \.pdf, \.svg"):
        map_figure(bump_map(), tmp_path / name)
    assert not list(tmp_path.iterdir())


def few_map() -> TactileMap:
    """Two columns of cells, at x of 19 and 20 mm, with nine readings."""
    whole = bump_map()
    count = whole.count.copy()
    count[:, -2:] = 9
    return replace(whole, count=count)


def hatching(axes) -> list:
    return [one for one in axes.collections if one.get_clip_path() is not None]


@pytest.mark.long
def test_cells_with_few_readings_are_hatched_and_no_others(tmp_path, axes):
    map_figure(few_map(), tmp_path / "few.png")
    left, right, *_ = axes[0].figure.axes
    for panel in (left, right):
        (lines,) = hatching(panel)
        cells, _ = lines.get_clip_path().get_transformed_path_and_affine()
        span = lines.get_clip_path()._path.get_extents()
        assert (span.x0, span.x1, span.y0, span.y1) == (18.5, 20.5, -15.5, 15.5)
        assert len(cells.vertices) == 5 * 2 * 31
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["fewer than 10 readings: noisy"]


def test_a_map_read_well_everywhere_has_no_hatching(axes):
    map_figure(bump_map(), None)
    left, right, *_ = axes[0].figure.axes
    assert not hatching(left) + hatching(right)
    assert right.get_legend() is None


@pytest.mark.long
def test_hatching_shows_without_colour(tmp_path, axes):
    """In grey the hatched cells hold both nearly black and nearly white; cells beside them do not."""
    from PIL import Image

    map_figure(few_map(), tmp_path / "few.png")
    grey = np.asarray(Image.open(tmp_path / "few.png").convert("L"), dtype=float)[::-1]
    for panel in axes[0].figure.axes[:2]:
        for x_mm, hatched in ((19.5, True), (15.5, False)):
            corners = panel.transData.transform([(x_mm - 0.8, -10.0), (x_mm + 0.8, 10.0)])
            (left, right), (bottom, top) = (sorted(corners[:, axis].astype(int)) for axis in (0, 1))
            part = grey[bottom:top, left:right]
            both = min((part < 60).mean(), (part > 200).mean())
            assert (both > 0.05) == hatched, (x_mm, both)


def test_noise_alone_does_not_fill_the_colours(axes):
    flat = bump_map()
    noise = np.random.default_rng(0).normal(1, 0.01, flat.mean.shape)
    map_figure(replace(flat, mean=np.where(flat.count > 0, noise, np.nan)), None)
    low, high = axes[0].images[0].get_clim()
    assert low < 0.91
    assert high > 1.29


def test_a_cell_with_few_readings_does_not_set_the_colours(axes):
    edge = bump_map()
    mean, count = edge.mean.copy(), edge.count.copy()
    mean[20, 20], count[20, 20] = 40.0, 1
    map_figure(replace(edge, mean=mean, count=count), None)
    assert axes[0].images[0].get_clim()[1] < 2


def test_a_map_without_data_is_not_drawn(tmp_path):
    empty = bump_map()
    empty = replace(empty, count=np.zeros_like(empty.count), mean=np.full(empty.mean.shape, np.nan))
    with pytest.raises(BadDataError, match="no data to draw"):
        map_figure(empty, tmp_path / "map.png")
    assert not list(tmp_path.iterdir())


def test_an_existing_picture_stays_without_force(tmp_path):
    path = tmp_path / "map.png"
    path.write_text("mine")
    with pytest.raises(UsageError, match="--force"):
        map_figure(bump_map(), path)
    with pytest.raises(UsageError, match="--force"):
        size_figure(draws(0, 15), draws(1, 12), path)
    assert path.read_text() == "mine"
    map_figure(bump_map(), path, force=True)
    assert png_size(path)


def test_a_size_is_drawn_with_its_intervals_named(tmp_path, axes):
    for name in ("a.png", "b.png"):
        size_figure(draws(0, 15), draws(1, 12), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert [text.get_text() for text in axes[0].texts] == [
        "largest, 12.0 to 18.0 mm: 95 % interval (equal-tailed)",
        "smallest, 9.0 to 15.0 mm: 95 % interval (equal-tailed)",
    ]


def test_the_axis_of_sizes_ends_near_its_intervals_and_medians_are_marked(axes):
    heavy = np.concatenate([draws(0, 15)[:-2], [90.0, 120.0]])
    size_figure(heavy, draws(1, 12), None)
    low, high = axes[0].get_xlim()
    assert 5 < low < 9
    assert 18 < high < 22
    assert axes[0].get_title(loc="left") == "Size of the lump: s01"
    marks = [float(one.get_segments()[0][0][0]) for one in axes[0].collections if hasattr(one, "get_segments")]
    assert sorted(marks) == pytest.approx(sorted([np.median(heavy), np.median(draws(1, 12))]))


def test_densities_have_area_one_and_their_draws_mean(axes):
    size_figure(draws(0, 15), draws(1, 12), None)
    for line, centre in zip(densities(axes[0]), (15, 12), strict=True):
        x, y = line.get_data()
        assert integral(y, x) == pytest.approx(1, abs=0.01)
        assert integral(x * y, x) == pytest.approx(centre, abs=0.2)


def test_a_density_of_sizes_stays_above_zero(axes):
    size_figure(np.abs(draws(0, 0)), np.abs(draws(1, 0)) / 2, None)
    for line in densities(axes[0]):
        x, y = line.get_data()
        assert x.min() >= 0
        assert integral(y, x) == pytest.approx(1, abs=0.02)
        assert y[0] == pytest.approx(y.max(), rel=0.1)


def test_too_few_draws_are_refused(tmp_path):
    bad = np.array([np.nan, 3.0])
    with pytest.raises(BadDataError, match="finite draws cannot be drawn"):
        size_figure(bad, bad, tmp_path / "size.png")
    assert not list(tmp_path.iterdir())


def test_one_density_is_drawn_where_largest_and_smallest_are_the_same(axes):
    size = draws(0, 15)
    nearly = np.where(np.arange(len(size)) % 20 == 0, 0.9 * size, size)
    size_figure(size, nearly, None)
    assert len(axes[0].lines) == 2  # its density and the bar of its interval
    assert "the same in 95 % of the draws" in axes[0].get_legend().get_texts()[0].get_text()
    assert [text.get_text()[:8] for text in axes[0].texts] == ["largest,"]


def test_equal_draws_are_drawn(tmp_path):
    size_figure(np.full(9, 12.0), draws(0, 10)[:9], tmp_path / "size.png")
    assert png_size(tmp_path / "size.png") == (1050, 600)


@pytest.mark.long
def test_no_window_system_is_asked_for(run_python, tmp_path):
    code = "\n".join(
        [
            "import sys, numpy as np",
            "from pathlib import Path",
            "from tactile_bayes.report.estimate_figures import corner_figure",
            "r = np.random.default_rng(0)",
            "drawn = {'max_size_mm': r.normal(15, 1, (1, 99)), 'amplitude': r.normal(1, 1, (1, 99))}",
            "corner_figure(drawn, Path('s.png'))",
            "assert 'matplotlib.pyplot' not in sys.modules, 'pyplot'",
        ]
    )
    done = run_python("-c", code, cwd=tmp_path, env={"MPLBACKEND": "module://nowhere"})
    assert done.returncode == 0, done.stderr


def test_every_command_that_draws_refuses_another_suffix_before_any_work():
    import importlib

    import click

    from tactile_bayes.cli import COMMANDS

    def commands(command: click.Command) -> list[click.Command]:
        if not isinstance(command, click.Group):
            return [command]
        inner = [command.get_command(click.Context(command), name) for name in command.list_commands(None)]
        return [one for part in inner for one in commands(part)]

    found = []
    for place, _ in COMMANDS.values():
        module, name = place.split(".")
        top = getattr(importlib.import_module(f"tactile_bayes.commands.{module}"), name)
        for command in commands(top):
            found += [
                one.type for one in command.params if one.name in ("figure", "map_figure", "trace", "rank", "corner")
            ]
    # map, calibrate size, two of estimate, compare, three of diagnose, head design, compare-model, sbc, three of
    # tradeoff
    assert len(found) == 15
    assert all(one.writes == "figure" for one in found)


def test_the_regions_of_pairs_say_how_many_draws_they_hold() -> None:
    rng = np.random.default_rng(3)
    figure = corner_figure({"max_size_mm": rng.normal(15, 1, (1, 400)), "amplitude": rng.normal(0, 1, (1, 400))}, None)
    assert figure.get_suptitle() == "Corner: dark 50 %, light 90 % of the draws"
