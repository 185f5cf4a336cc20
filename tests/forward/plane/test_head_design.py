"""The homogeneous-pressure condition, against the contact mechanics of a half-plane (Johnson 1985)."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from tactile_bayes.cli import cli
from tactile_bayes.errors import EXIT_USAGE, BadDataError, UsageError
from tactile_bayes.forward.scene import HeadSection
from tactile_bayes.presets import SHOULDERS_INSIDE, SHOULDERS_OUTSIDE
from tactile_bayes.studies.paper import HomogeneousTissue, most_even, narrowest, search_heads, uniformity

PAPER_LIMIT = 0.075
"""Largest departure of the pressure from its mean, as a share of it: Wellman & Howe (1999), section 2.1."""

THICK_MM = 5000.0  # 200 widths of the head: a half-plane
EDGES = np.linspace(-12.0, 12.0, 17)  # of the 16 taxels
SMALL = {"radii_mm": (35.0, 70.0, 80.0), "shoulders_mm": (3.0, 15.0)}


def taxel_means(primitive) -> np.ndarray:
    """Means over the taxels of a profile with the given primitive, over their mean."""
    values = np.diff(primitive(EDGES))
    return values / values.mean()


def test_a_flat_head_is_the_punch_of_a_half_plane() -> None:
    """p / mean = 2 / (pi sqrt(1 - s^2/w^2)), Johnson eq. 2.64, at every pressure."""
    found = uniformity(
        HeadSection(radius_mm=np.inf, shoulder_mm=0.0),
        HomogeneousTissue(thickness_mm=THICK_MM, modulus_kpa=(15.0, 25.0)),
    )
    expected = taxel_means(lambda s: np.arcsin(s / 12.0))
    np.testing.assert_allclose(found.share[..., 2:-2], np.broadcast_to(expected, (3, 3, 16))[..., 2:-2], rtol=0.01)
    # The singular edge is spread over a cell of 0.5 mm, as for any method of cells.
    np.testing.assert_allclose(found.share[..., 0], expected[0], rtol=0.04)
    assert np.ptp(found.share, axis=(0, 1)).max() < 1e-8


def test_a_round_head_that_touches_in_part_is_hertz() -> None:
    """Half-width of contact a = sqrt(4 P R (1 - nu^2) / (pi E)), Johnson eq. 4.43; P1 of Eq 1 with a real a.

    The radius is large, so that the head's circle is the parabola of the theory.
    """
    radius, nu, tissue_kpa, mean_kpa = 300.0, 0.3, 50.0, 0.5
    tissue = HomogeneousTissue(
        modulus_kpa=(tissue_kpa, tissue_kpa), pressure_kpa=(mean_kpa, mean_kpa), thickness_mm=THICK_MM, poisson=nu
    )
    a = np.sqrt(4 * (24 * mean_kpa) * radius * (1 - nu**2) / (np.pi * tissue_kpa))
    assert 8.0 < a < 10.0
    inside = np.clip(EDGES, -a, a)
    expected = taxel_means(lambda _: 0.5 * (inside * np.sqrt(a**2 - inside**2) + a**2 * np.arcsin(inside / a)))
    found = uniformity(HeadSection(radius_mm=radius, shoulder_mm=0.0), tissue, cell_mm=0.125)
    np.testing.assert_allclose(found.share[0, 0], expected, atol=0.01)
    other = uniformity(HeadSection(radius_mm=0.9 * radius, shoulder_mm=0.0), tissue, cell_mm=0.125)
    assert np.abs(other.share[0, 0] - expected).max() > 0.05  # the negative control: another radius is seen


def test_only_the_ratio_of_pressure_to_modulus_matters() -> None:
    head = HeadSection(radius_mm=60.0, shoulders=SHOULDERS_OUTSIDE)
    plain = uniformity(head, HomogeneousTissue())
    scaled = uniformity(head, HomogeneousTissue(modulus_kpa=(45.0, 75.0), pressure_kpa=(15.0, 42.0)))
    np.testing.assert_allclose(plain.share, scaled.share, rtol=1e-9)
    other = uniformity(head, HomogeneousTissue(modulus_kpa=(45.0, 75.0)))
    assert np.abs(plain.share - other.share).max() > 0.1


def test_three_cells_a_taxel_are_enough() -> None:
    head = HeadSection(radius_mm=70.0, shoulder_mm=15.0, shoulders=SHOULDERS_OUTSIDE)
    tissue = HomogeneousTissue()
    coarse, fine = (uniformity(head, tissue, cell_mm=cell).worst for cell in (0.5, 0.25))
    assert coarse == pytest.approx(fine, abs=0.001)


def test_the_papers_condition_is_met_by_wide_shoulders_around_the_array_and_by_no_head_without() -> None:
    tissue = HomogeneousTissue()
    found = search_heads(tissue, **SMALL)
    answer = narrowest(found, limit=PAPER_LIMIT)
    assert answer is not None
    assert (answer.head.radius_mm, answer.head.shoulder_mm) == (70.0, 15.0)
    assert answer.head.shoulders == SHOULDERS_OUTSIDE
    assert answer.worst == pytest.approx(0.064, abs=0.001)
    assert most_even(found).worst <= answer.worst
    inside = [one for one in found if one.head.shoulders == SHOULDERS_INSIDE]
    assert narrowest(inside, limit=PAPER_LIMIT) is None
    assert min(one.worst for one in inside) > 0.5


def test_another_reading_of_variation_asks_less() -> None:
    found = search_heads(HomogeneousTissue(), kinds=(SHOULDERS_OUTSIDE,), radii_mm=(60.0,), shoulders_mm=(6.0,))
    assert narrowest(found, limit=PAPER_LIMIT) is None
    by_rms = narrowest(found, limit=PAPER_LIMIT, by_rms=True)
    assert by_rms is not None
    assert by_rms.worst_rms == pytest.approx(np.sqrt(np.mean((by_rms.share - 1) ** 2, axis=-1)).max())


def test_a_range_that_runs_backwards_is_refused() -> None:
    with pytest.raises(BadDataError, match="pressure_kpa is 14 to 5"):
        HomogeneousTissue(pressure_kpa=(14.0, 5.0))


def run(*words: object):
    return CliRunner().invoke(cli, [str(word) for word in words])


def test_the_command_says_what_one_head_does() -> None:
    done = run("head", "uniformity", "--head-radius-mm", 70, "--shoulder-mm", 15, "--head", SHOULDERS_OUTSIDE)
    assert done.exit_code == 0, done.output
    assert "face 48.9 mm wide" in done.stdout
    assert "largest departure 6.4 %, within 7.5 %" in done.stdout
    assert "Research use only" in done.stdout
    document = json.loads(run("head", "uniformity", "--json").stdout)
    assert document["schema"] == "tactile-bayes/head-uniformity/1"
    assert document["within_limit"] is False
    assert np.shape(document["largest"]) == (3, 3)


def test_where_no_head_meets_the_limit_the_command_says_so_and_fails(monkeypatch) -> None:
    from functools import partial

    from tactile_bayes.studies import paper

    monkeypatch.setattr(paper, "search_heads", partial(search_heads, **SMALL))
    done = run("head", "design", "--head", SHOULDERS_INSIDE)
    assert isinstance(done.exception, UsageError)
    assert done.exception.exit_code == EXIT_USAGE
    assert "no head keeps the pressure within 7.5 % of its mean" in str(done.exception)
    assert "0 of 3 heads" in done.stdout  # shoulders of 15 mm do not fit inside


@pytest.mark.long
def test_the_picture_and_the_json_hold_the_search(tmp_path, monkeypatch) -> None:
    from functools import partial

    from tactile_bayes.studies import paper

    monkeypatch.setattr(paper, "search_heads", partial(search_heads, **SMALL))
    done = run("head", "design", "--figure", tmp_path / "head.png", "--json")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["answer"]["radius_mm"] == 70.0
    assert len(document["heads"]) == 9
    assert (tmp_path / "head.png").stat().st_size > 20_000
    again = run("head", "design", "--figure", tmp_path / "head.png")
    assert "exists" in str(again.exception)
