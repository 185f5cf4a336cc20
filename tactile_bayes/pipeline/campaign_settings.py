"""Settings of all exams of a campaign."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.presets import DEFAULT_NORMALISE, MATCH_MM
from tactile_bayes.records import dataclass


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """Settings of all exams.

    Parameters
    ----------
    estimate
        As of `estimate`; a row of the table may replace place, known values and calibration.
    normalise
        As of `map`.
    match_mm
        Within this distance a mass is that which another exam of the breast names by its place.
    figures
        Whether the figures of `estimate` are drawn for each exam.
    own_repeatability
        Whether the spread between exams is learned from the campaign's own repeats, where enough masses have them and
        the estimate's settings do not say it.
    copy_to
        Address of a folder in an object store that gets a copy of every file; empty for none.
    """

    estimate: Settings = field(default_factory=Settings)
    normalise: str = DEFAULT_NORMALISE
    figures: bool = False
    match_mm: float = MATCH_MM
    own_repeatability: bool = True
    copy_to: str = ""

    def of(self, exam: Exam) -> Settings:
        """Settings of one exam's estimate."""
        given: dict[str, Any] = {
            "centre_mm": exam.centre_mm,
            "calibration": exam.calibration,
            "known": exam.known or None,
        }
        return replace(self.estimate, **{name: value for name, value in given.items() if value is not None})
