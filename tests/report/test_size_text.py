"""What a report says of a lump's form, by the odds of an oval."""

from __future__ import annotations

import pytest

from tactile_bayes.report.estimate_text import shape_text


@pytest.mark.parametrize(
    ("probability", "half_log_ratio", "irregular", "words"),
    [
        (0.001, 0.001, 0.0, "Sized as round; an oval lump is improbable (below 0.005)."),
        (0.1, 0.0953, 0.0, "Sized as round; an oval lump (probability 0.10) would be 10 % longer."),
        (0.8, 0.2231, 0.0, "Oval (probability 0.80): 25 % longer than a round lump of the same mean size."),
        (0.001, 0.0, 1.0, "Irregular outline. Sized as round; an oval lump is improbable (below 0.005)."),
    ],
)
def test_the_form_is_told_in_words(probability: float, half_log_ratio: float, irregular: float, words: str) -> None:
    """A half log ratio of h makes the largest size e^h times that of a ball: 0.0953 is ln 1.1, 0.2231 is ln 1.25."""
    figures = {"oval_probability": probability, "oval_half_log_ratio": half_log_ratio, "irregular_outline": irregular}
    assert shape_text(figures) == words
