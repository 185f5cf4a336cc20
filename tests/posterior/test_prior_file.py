"""Priors from a file: what is given is used and printed, what is not known or not possible is one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactile_bayes.errors import BadDataError
from tactile_bayes.files.prior_toml import read_prior
from tactile_bayes.files.schema import load_schema
from tactile_bayes.posterior.lump.bump import BumpPrior
from tactile_bayes.posterior.sensitivity import prior_sensitivity
from tactile_bayes.report.scene_text import prior_line, sensitivity_line


def test_what_is_left_out_keeps_its_default(tmp_path: Path) -> None:
    path = tmp_path / "prior.toml"
    path.write_text("width_median_mm = 4\nlog_width_sd = 0.7\n", encoding="utf-8")
    assert read_prior(path) == BumpPrior(width_median_mm=4.0, log_width_sd=0.7)
    assert read_prior(None) == BumpPrior()


def test_the_schema_has_the_programs_priors() -> None:
    properties = load_schema("prior.schema.json")["properties"]
    assert {name: one["default"] for name, one in properties.items()} == BumpPrior().as_dict()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("widht_median_mm = 4", "unknown key widht_median_mm"),
        ("width_median_mm = -4", "width_median_mm must be"),
        ("width_median_mm = nan", "width_median_mm is nan"),
        ("tilt_sd = inf", "tilt_sd"),
        ('amplitude_sd = "2"', "amplitude_sd must be number"),
        ("amplitude_sd = ", "is not TOML"),
    ],
)
def test_a_bad_prior_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "prior.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BadDataError, match=message) as caught:
        read_prior(path)
    assert "\n" not in str(caught.value)
    assert "prior.toml" in str(caught.value)


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match=r"nothing\.toml"):
        read_prior(tmp_path / "nothing.toml")


def test_every_prior_is_printed() -> None:
    line = prior_line(BumpPrior(1.5, 4.5, 0.75, 0.25, 0.125), field=True)
    for number in ("1.5", "4.5", "0.75", "0.25", "0.125"):
        assert number in line


def test_weighing_draws_anew_is_the_other_posterior() -> None:
    """A normal likelihood of ln sigma times the normal prior: both posteriors are known."""
    prior, mean, sd = BumpPrior(), np.log(9.0), 0.4
    rng = np.random.default_rng(1)

    def posterior(prior_sd: float) -> tuple[float, float]:
        precision = 1 / sd**2 + 1 / prior_sd**2
        return (mean / sd**2 + np.log(prior.width_median_mm) / prior_sd**2) / precision, precision**-0.5

    (middle, narrow), (wider, wide) = posterior(prior.log_width_sd), posterior(2 * prior.log_width_sd)
    draws = np.exp(middle + narrow * rng.standard_normal((1, 200_000)))
    found = prior_sensitivity(draws, draws, {"sigma_x_mm": np.log(draws)}, prior)
    assert found.median["sigma_x_mm"] == pytest.approx((wider - middle) / narrow, abs=0.01)
    upper = (wider + 1.96 * wide - middle - 1.96 * narrow) / narrow
    assert found.ends["sigma_x_mm"] == pytest.approx(upper, abs=0.02)
    assert "would move by +0." in sensitivity_line(found)
    # the negative control: a width that the data give alone does not move
    sharp = np.exp(np.log(5.0) + 0.01 * rng.standard_normal((1, 8000)))
    assert abs(prior_sensitivity(sharp, sharp, {"sigma_x_mm": sharp}, prior).median["sigma_x_mm"]) < 0.01
