"""Settings of a campaign, and how far it is."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import field, replace
from typing import Any, Final

from tactile_bayes.files.manifest_csv import Exam
from tactile_bayes.pipeline.campaign_folder import StepResults
from tactile_bayes.pipeline.campaign_steps import Result
from tactile_bayes.pipeline.settings import Settings
from tactile_bayes.presets import DEFAULT_NORMALISE
from tactile_bayes.records import dataclass

MATCH_MM: Final = 15.0
"""Default distance for matching a mass by its place: half of what lies between two masses that are told apart."""


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """Settings of all exams.

    Parameters
    ----------
    estimate
        As of `estimate`; a row of the table may replace place, known values and calibration.
    normalise
        As of `map`.
    figures
        Whether the figures of `estimate` are drawn for each exam.
    match_mm
        Within this distance a mass is that which another exam of the breast names by its place.
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


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a step of an exam or a mass gave nothing."""

    step: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class CampaignState:
    """How far a campaign is: results by step and name, faults by name, counts and times of steps.

    Parameters
    ----------
    results
        By step, then by the name of the exam or mass.
    faults
        By the name of the exam or mass.
    kept, todo
        Steps done by earlier runs, and steps of this run, by step; for a plan those that it would do.
    seconds
        Median time that one of each step took so far.
    """

    results: dict[str, StepResults]
    faults: dict[str, Fault] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    todo: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    seconds: dict[str, float] = field(default_factory=dict)

    def of(self, step: str, name: str) -> Result | None:
        """Result of a step of an exam or mass; None where there is none."""
        return self.results[step].get(name)
