"""Simulated exams that vary as bodies and examiners do: the training set of a size calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from tactile_bayes.forward.scene import Background, Head, Noise, Scene, Strokes, Tracker
from tactile_bayes.forward.tissue import SceneBody, SolidLump

Range = tuple[float, float]

# Half the rate of a real head: twice the frames would halve the readings' noise, which is small beside the rest.
FRAME_RATE_HZ = 100.0


@dataclass(frozen=True, slots=True)
class BodyPrior:
    """Ranges of lumps and bodies, drawn independently; sizes, stiffnesses and moduli on the log scale.

    Parameters
    ----------
    d_mm
        Diameter of the lump, a ball.
    depth_ratio
        h/d, from just under the skin to where nothing is felt any more.
    stiffness_ratio
        E2/E1, from the softer carcinomas under a few per cent of strain (Samani et al. 2007) to rigid.
    seat
        From centred on the fat-gland boundary to a tenth of a diameter above the gland.
    fat_kpa, gland_ratio
        About the paper's 5 kPa and 10.
    thickness_mm
        Of the breast under the head; more where the lump needs it.
    """

    d_mm: Range = (5.0, 30.0)
    depth_ratio: Range = (0.56, 1.8)
    stiffness_ratio: Range = (6.0, 100.0)
    seat: Range = (0.0, 1.2)
    fat_kpa: Range = (3.5, 7.5)
    gland_ratio: Range = (5.0, 16.0)
    thickness_mm: Range = (40.0, 90.0)


@dataclass(frozen=True, slots=True)
class ExamPrior:
    """Ranges of an examiner's technique and of the instrument's errors, drawn anew for each scan.

    Parameters
    ----------
    mean_kpa, drift_kpa, tilt_deg, wander_mm, yaw_deg
        As in `Background` and `Strokes`.
    lines, spacing_mm, half_length_mm
        As in `Strokes`.
    off_centre_mm
        How far the strokes' middle lies from the lump, each way.
    line_s
        Time for a line.
    element_kpa, tracker_mm, tracker_deg, gain_share, latency_ms
        As in `Noise` and `Tracker`.
    """

    mean_kpa: Range = (7.0, 12.0)
    drift_kpa: Range = (0.2, 1.5)
    yaw_deg: Range = (-30.0, 30.0)
    tilt_deg: Range = (0.5, 4.0)
    wander_mm: Range = (0.2, 1.5)
    lines: tuple[int, int] = (4, 7)
    spacing_mm: Range = (4.0, 7.0)
    half_length_mm: Range = (28.0, 38.0)
    off_centre_mm: Range = (-6.0, 6.0)
    line_s: Range = (1.0, 1.8)
    element_kpa: Range = (0.02, 0.3)
    tracker_mm: Range = (0.05, 0.6)
    tracker_deg: Range = (0.02, 0.3)
    gain_share: Range = (0.002, 0.02)
    latency_ms: Range = (0.0, 12.0)


def draw_body(prior: BodyPrior, rng: np.random.Generator) -> tuple[SceneBody, SolidLump]:
    """Draw one body and its lump."""
    d = _log_uniform(prior.d_mm, rng)
    ratio, seat = rng.uniform(*prior.depth_ratio), rng.uniform(*prior.seat)
    stiffness = _log_uniform(prior.stiffness_ratio, rng)
    fat_kpa, gland = _log_uniform(prior.fat_kpa, rng), _log_uniform(prior.gland_ratio, rng)
    # room below the lump and for some gland below the fat
    least = ratio * d + max(0.6, 0.5 * seat + 0.05) * d + 4.0
    thickness = max(rng.uniform(*prior.thickness_mm), least)
    body = SceneBody(fat_kpa=fat_kpa, gland_ratio=gland, thickness_mm=thickness)
    return body, SolidLump(d_mm=d, depth_ratio=ratio, stiffness_ratio=stiffness, seat=seat)


def draw_exam(prior: ExamPrior, rng: np.random.Generator) -> Scene:
    """Draw one examination of a body; the lump lies in the middle, shifted by `off_centre_mm`."""
    lines = int(rng.integers(prior.lines[0], prior.lines[1] + 1))
    mean, drift = rng.uniform(*prior.mean_kpa), rng.uniform(*prior.drift_kpa)
    background = Background(mean_kpa=mean, drift_kpa=drift, drift_period_s=rng.uniform(1.5, 5.0))
    strokes = Strokes(
        lines=lines,
        spacing_mm=rng.uniform(*prior.spacing_mm),
        half_length_mm=rng.uniform(*prior.half_length_mm),
        wander_mm=rng.uniform(*prior.wander_mm),
        tilt_deg=rng.uniform(*prior.tilt_deg),
        yaw_deg=rng.uniform(*prior.yaw_deg),
    )
    noise = Noise(
        element_kpa=rng.uniform(*prior.element_kpa),
        tracker_mm=rng.uniform(*prior.tracker_mm),
        tracker_deg=rng.uniform(*prior.tracker_deg),
        gain_share=rng.uniform(*prior.gain_share),
    )
    tracker = Tracker(latency_ms=rng.uniform(*prior.latency_ms))
    duration = lines * rng.uniform(*prior.line_s)
    return Scene(
        duration_s=duration,
        frame_rate_hz=FRAME_RATE_HZ,
        background=background,
        strokes=strokes,
        noise=noise,
        tracker=tracker,
    )


def draw_mass(
    index: int,
    *,
    scans: int,
    seed: int,
    bodies: BodyPrior | None = None,
    exams: ExamPrior | None = None,
    head: Head | None = None,
) -> list[Scene]:
    """Draw the scenes of one mass, examined several times; they depend only on index, seed, priors and head.

    Parameters
    ----------
    index
        Number of the mass.
    scans
        Exams of it.
    bodies, exams
        Priors; None for the defaults.
    head
        None for the paper's.
    """
    rng = np.random.default_rng([seed, index])
    body, lump = draw_body(bodies or BodyPrior(), rng)
    exam_prior = exams or ExamPrior()
    scenes = []
    for number in range(scans):
        exam = draw_exam(exam_prior, rng)
        x, y = rng.uniform(*exam_prior.off_centre_mm, size=2)
        placed = replace(lump, x_mm=float(x), y_mm=float(y))
        scene_seed = int(np.random.SeedSequence([seed, index, number]).generate_state(1)[0])
        scenes.append(replace(exam, seed=scene_seed, body=body, solid_lumps=(placed,), head=head or Head()))
    return scenes


def centred(bodies: BodyPrior) -> BodyPrior:
    """Copy the prior with every lump's centre on the fat-gland boundary, as in the paper."""
    return replace(bodies, seat=(0.0, 0.0))


def as_settings(bodies: BodyPrior, exams: ExamPrior) -> Mapping[str, object]:
    """Plain data for a table's header and a calibration's provenance."""
    return {"bodies": asdict(bodies), "exams": asdict(exams)}


def _log_uniform(ends: Range, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(ends[0]), np.log(ends[1]))))
