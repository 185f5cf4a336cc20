"""Pictures: written whole, the same bytes each time, drawn as the examiner sees the breast."""

from __future__ import annotations

import stat
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError, UsageError
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.tactile_map import MapRecipe, TactileMap
from tactile_bayes.report import figures
from tactile_bayes.report.figures import FitContour, SizeInterval, map_figure, size_figure

INTERVALS = {
    "max": SizeInterval(12.0, 18.0, 0.95, "equal-tailed"),
    "min": SizeInterval(9.0, 15.0, 0.95, "equal-tailed"),
}
FIT = FitContour((3.0, -2.0), 6.0, 4.0, 20.0)


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


@pytest.fixture
def axes(monkeypatch):
    """The figure that was written last, for looking at what is on it."""
    kept = []
    original = figures._finish_size

    def keep(one):
        original(one)
        kept.append(one)

    monkeypatch.setattr(figures, "_finish_size", keep)
    values = figures._draw_values

    def keep_map(one, tactile_map):
        values(one, tactile_map)
        kept.append(one)

    monkeypatch.setattr(figures, "_draw_values", keep_map)
    return kept


@pytest.mark.parametrize(("fit", "normalise"), [(None, "mean"), (FIT, "gain"), (None, "none")])
def test_a_map_is_drawn_in_the_same_bytes_each_time(tmp_path, fit, normalise):
    for name in ("a.png", "b.png"):
        map_figure(bump_map(normalise=normalise), tmp_path / name, fit=fit, title="Map 1")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert b"Matplotlib" not in (tmp_path / "a.png").read_bytes()
    assert png_size(tmp_path / "a.png") == (1500, 675)
    assert stat.S_IMODE((tmp_path / "a.png").stat().st_mode) == 0o600


def test_a_users_matplotlib_settings_do_not_change_the_picture(tmp_path):
    import matplotlib

    map_figure(bump_map(), tmp_path / "a.png")
    with matplotlib.rc_context({"font.size": 30, "image.cmap": "jet", "savefig.dpi": 20}):
        map_figure(bump_map(), tmp_path / "b.png")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("notch", "x_to_the_left", "y_up"), [((0.0, 1.0), True, True), ((0.0, -1.0), False, False), (None, True, True)]
)
def test_the_viewer_looks_into_the_tissue_with_the_notch_above(tmp_path, axes, notch, x_to_the_left, y_up):
    to_patient = None
    if notch is not None:
        y_axis = np.array([*notch, 0.0])
        to_patient = rigid(np.stack([np.cross(y_axis, [0, 0, 1.0]), y_axis, [0, 0, 1.0]]), np.zeros(3))
    map_figure(replace(bump_map(), patient_from_plane=to_patient), tmp_path / "map.png")
    assert axes[0].xaxis_inverted() == x_to_the_left
    assert axes[0].yaxis_inverted() != y_up
    # One axis turned, never both or none: two would show the breast from within.
    assert axes[0].xaxis_inverted() != axes[0].yaxis_inverted()


def test_an_imported_grid_is_drawn_as_it_is(tmp_path, axes):
    map_figure(replace(bump_map(), plane_from_base=None), tmp_path / "map.png")
    assert not axes[0].xaxis_inverted()
    assert not axes[0].yaxis_inverted()


def test_the_fit_is_drawn_as_ellipses_of_one_and_two_sigma(tmp_path, axes):
    map_figure(bump_map(), tmp_path / "map.png", fit=FIT)
    ellipses = axes[0].patches
    assert [(one.width, one.height, one.angle) for one in ellipses] == [(12.0, 8.0, 20.0), (24.0, 16.0, 20.0)]
    assert {one.center for one in ellipses} == {(3.0, -2.0)}


def few_map() -> TactileMap:
    """Two columns of cells, at x of 19 and 20 mm, with nine readings."""
    whole = bump_map()
    count = whole.count.copy()
    count[:, -2:] = 9
    return replace(whole, count=count)


def hatching(axes) -> list:
    return [one for one in axes.collections if one.get_clip_path() is not None]


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


def test_a_map_read_well_everywhere_has_no_hatching(tmp_path, axes):
    map_figure(bump_map(), tmp_path / "well.png")
    left, right, *_ = axes[0].figure.axes
    assert not hatching(left) + hatching(right)
    assert right.get_legend() is None


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


def test_noise_alone_does_not_fill_the_colours(tmp_path, axes):
    flat = bump_map()
    noise = np.random.default_rng(0).normal(1, 0.01, flat.mean.shape)
    map_figure(replace(flat, mean=np.where(flat.count > 0, noise, np.nan)), tmp_path / "map.png")
    low, high = axes[0].images[0].get_clim()
    assert low < 0.91
    assert high > 1.29


def test_a_cell_with_few_readings_does_not_set_the_colours(tmp_path, axes):
    edge = bump_map()
    mean, count = edge.mean.copy(), edge.count.copy()
    mean[20, 20], count[20, 20] = 40.0, 1
    map_figure(replace(edge, mean=mean, count=count), tmp_path / "map.png")
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
        size_figure(draws(0, 15), draws(1, 12), path, intervals=INTERVALS)
    assert path.read_text() == "mine"
    map_figure(bump_map(), path, force=True)
    assert png_size(path)


def test_a_size_is_drawn_with_its_intervals_named(tmp_path, axes):
    for name in ("a.png", "b.png"):
        size_figure(draws(0, 15), draws(1, 12), tmp_path / name, intervals=INTERVALS, truth=(15.0, 13.0))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert [text.get_text() for text in axes[0].texts] == [
        "12.0 to 18.0 mm, 95 % equal-tailed interval",
        "9.0 to 15.0 mm, 95 % equal-tailed interval",
    ]


def test_densities_have_area_one_and_their_draws_mean(tmp_path, axes):
    size_figure(draws(0, 15), draws(1, 12), tmp_path / "size.png", intervals={})
    for line, centre in zip(axes[0].lines, (15, 12), strict=True):
        x, y = line.get_data()
        assert integral(y, x) == pytest.approx(1, abs=0.01)
        assert integral(x * y, x) == pytest.approx(centre, abs=0.2)


def test_a_density_of_sizes_stays_above_zero(tmp_path, axes):
    size_figure(np.abs(draws(0, 0)), np.abs(draws(1, 0)) / 2, tmp_path / "size.png", intervals={})
    for line in axes[0].lines:
        x, y = line.get_data()
        assert x.min() >= 0
        assert integral(y, x) == pytest.approx(1, abs=0.02)
        assert y[0] == pytest.approx(y.max(), rel=0.1)


@pytest.mark.parametrize("bad", [np.array([]), np.array([np.nan, 3.0])])
def test_too_few_draws_are_refused(tmp_path, bad):
    with pytest.raises(BadDataError, match="finite draws cannot be drawn"):
        size_figure(bad, draws(0, 12), tmp_path / "size.png", intervals={})
    assert not list(tmp_path.iterdir())


def test_equal_draws_are_drawn(tmp_path):
    size_figure(np.full(9, 12.0), draws(0, 10), tmp_path / "size.png", intervals=INTERVALS)
    assert png_size(tmp_path / "size.png") == (1050, 600)


def test_no_window_system_is_asked_for(run_python, tmp_path):
    code = "\n".join(
        [
            "import sys, numpy as np",
            "from pathlib import Path",
            "from tactile_bayes.report.figures import size_figure",
            "r = np.random.default_rng(0)",
            "size_figure(r.normal(15, 1, 99), r.normal(12, 1, 99), Path('s.png'), intervals={})",
            "assert 'matplotlib.pyplot' not in sys.modules, 'pyplot'",
        ]
    )
    done = run_python("-c", code, cwd=tmp_path, env={"MPLBACKEND": "module://nowhere"})
    assert done.returncode == 0, done.stderr
