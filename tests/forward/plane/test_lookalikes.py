"""Fig 5b: frames of lumps of different size that look alike, and a search that can fail."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_bayes.report.study import lookalikes_text
from tactile_bayes.studies.paper import CentredFrame, Lookalikes, StudySettings, centred_frame, find_lookalikes

COARSE = StudySettings(fineness=1)
DEPTHS = (0.8, 1.0, 1.2, 1.5)


def test_the_pair_that_is_found_is_alike_in_the_model_itself() -> None:
    found = find_lookalikes(COARSE, seat=0.0, diameters_mm=(15.0, 25.0), depth_ratios=DEPTHS)
    assert found is not None
    assert (found.small.d_mm, found.large.d_mm) == (15.0, 25.0)
    assert found.difference < 0.07
    half = len(found.small.added) // 2
    assert min(one.added[half - 1 : half + 1].mean() for one in (found.small, found.large)) > 0.095
    again = centred_frame(25.0, found.large.depth_ratio, settings=COARSE, seat=0.0)
    np.testing.assert_allclose(again.share, found.large.share)
    # The negative control: the same two sizes at one depth ratio are far apart.
    level = centred_frame(25.0, found.small.depth_ratio, settings=COARSE, seat=0.0)
    assert np.sqrt(np.mean((level.share - found.small.share) ** 2)) > 3 * found.of_mean


def test_without_two_visible_sizes_there_is_no_pair() -> None:
    assert find_lookalikes(COARSE, seat=0.0, diameters_mm=(5.0, 10.0), depth_ratios=(1.5, 1.8, 2.0)) is None
    assert find_lookalikes(COARSE, seat=0.0, diameters_mm=(10.0, 12.0), depth_ratios=(0.8, 1.0)) is None


@pytest.mark.parametrize(
    ("difference", "words"), [(0.04, "indistinguishable are d 10 mm at h/d 1"), (0.06, "no pair within 5 %")]
)
def test_the_line_says_whether_the_lumps_look_alike(difference: float, words: str) -> None:
    small = CentredFrame(10.0, 1.0, np.ones(4), 0.2 * np.ones(4))
    large = CentredFrame(15.0, 0.9, np.ones(4) + 0.2 * difference, 0.2 * np.ones(4))
    text = lookalikes_text(Lookalikes(small, large))
    assert words in text
    assert f"{20 * difference:.2f} % of the mean" in text
    assert "no two visible lumps" in lookalikes_text(None)
