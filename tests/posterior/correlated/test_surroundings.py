"""What rises beside a bump: sums by profiles and strips are those over the cells."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.declarations import replace
from tactile_bayes.posterior.bump import SMOOTHING_MM
from tactile_bayes.posterior.correlated import CLEAR_IN_WIDTHS, LEAST_CELLS, PIECE_MM, Surroundings
from tactile_bayes.posterior.draw import ModalBump
from tactile_bayes.posterior.marginal import Extra

BUMP, MIDDLE = ModalBump(0.3, 1.0, -2.0, 4.0, 4.0), (0.5, 0.5)


def surroundings() -> Surroundings:
    rng = np.random.default_rng(3)
    x, y = np.arange(-30.0, 31.0), np.arange(-25.0, 26.0)
    excess = 0.1 * rng.standard_normal((len(y), len(x)))
    excess[:4, :10] = -np.inf
    return Surroundings(x, y, excess)


def cell_by_cell(around: Surroundings, extra: Extra, place: tuple[float, float, float]) -> float:
    pieces: dict[int, list[float]] = {}
    for j, y in enumerate(around.y_mm):
        for i, x in enumerate(around.x_mm):
            away = np.hypot(x - 1.0, y + 2.0)
            if not np.isfinite(around.excess[j, i]) or away <= CLEAR_IN_WIDTHS * 4.0:
                continue
            wide = 4.0**2 + SMOOTHING_MM**2
            left = around.excess[j, i] - 0.3 * 4.0**2 / wide * np.exp(-0.5 * away**2 / wide)
            one, two, width = place[0], place[1], np.exp(place[2])
            piece = 0
            if extra == "second lump":
                near = np.hypot(x - one, y - two) / width
            else:
                near = (np.cos(one) * (x - 0.5) + np.sin(one) * (y - 0.5) - two) / width
                piece = int(np.floor((np.cos(one) * (y - 0.5) - np.sin(one) * (x - 0.5)) / PIECE_MM))
            sums = pieces.setdefault(piece, [0.0, 0.0])
            sums[0] += np.exp(-0.5 * near**2)
            sums[1] += np.exp(-0.5 * near**2) * left
    if not sum(number for number, _ in pieces.values()) > LEAST_CELLS:
        return -np.inf
    means = sorted(total / number for number, total in pieces.values() if number > 1.0)
    mean = sum(total for _, total in pieces.values()) / sum(number for number, _ in pieces.values())
    return min(mean, means[(len(means) - 1) // 2])


@pytest.mark.parametrize(
    ("extra", "places", "exact"),
    [
        ("second lump", [(15.0, 3.0, np.log(3.0)), (-12.0, -9.0, np.log(8.0)), (90.0, 90.0, np.log(3.0))], 1e-9),
        ("rib", [(0.3, 16.0, np.log(5.0)), (1.2, -12.0, np.log(3.0)), (2.0, 80.0, np.log(3.0))], 2e-3),
    ],
)
def test_a_rise_is_the_mean_over_the_cells_or_along_a_rib_the_median_piece(
    extra: Extra, places: list[tuple[float, float, float]], exact: float
) -> None:
    around = surroundings()
    found = around.rise(extra, np.array(places), BUMP, middle=MIDDLE)
    wanted = [cell_by_cell(around, extra, place) for place in places]
    assert wanted[-1] == -np.inf
    assert found == pytest.approx(wanted, abs=exact)
    assert np.ptp(wanted[:2]) > 3e-3  # the places differ by more than they may be off


def with_excess(excess: np.ndarray) -> Surroundings:
    return Surroundings(np.arange(-30.0, 31.0), np.arange(-25.0, 26.0), excess)


def test_another_lump_on_a_line_is_no_rib_along_it() -> None:
    """A second mass 34 mm away once had a rib fitted through both of them."""
    around = with_excess(np.zeros((51, 61)))
    distance = np.hypot(around.x_mm + 25.0, around.y_mm[:, None] - 15.0)
    along_y = np.array([(0.0, -25.5, np.log(5.0))])
    lump, ridge = np.exp(-0.5 * (distance / 4.0) ** 2), np.exp(-0.5 * ((around.x_mm + 25.0) / 4.0) ** 2)
    bare = replace(BUMP, amplitude=0.0)
    assert abs(with_excess(lump).rise("rib", along_y, bare, middle=MIDDLE)[0]) < 0.01
    assert with_excess(np.tile(ridge, (51, 1))).rise("rib", along_y, bare, middle=MIDDLE)[0] > 0.3
