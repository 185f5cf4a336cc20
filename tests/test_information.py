"""The study of what frames tell: its regression and its figures, against what is known by construction."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.information_expansion import CHOSEN, expansion, expansion_columns
from benchmarks.information_frames import Bump, HeadFrames
from benchmarks.information_gp import BodyProcess, Exams, left_out

SHAPE, PITCH_MM = (16, 26), 1.5
SIGMA_MM = np.array([5.0, 6.0])
TRUE = np.array([1.0, -0.5, -0.1, 0.2, -0.7, -0.1])


def exams_of(rng: np.random.Generator, bodies: int) -> tuple[Exams, np.ndarray]:
    features = rng.standard_normal((2 * bodies, 3))
    body = np.repeat(np.arange(bodies), 2)
    return Exams(features, body), features


def test_the_gradient_is_that_of_differences():
    rng = np.random.default_rng(1)
    exams, _ = exams_of(rng, 30)
    process = BodyProcess(exams.scaled(), rng.standard_normal(30))
    theta, kept = process.start() + 0.1 * rng.standard_normal(len(process.start())), np.arange(30) % 3 > 0
    steps = 1e-5 * np.eye(len(theta))
    differences = [
        (process.objective(theta + step, kept)[0] - process.objective(theta - step, kept)[0]) / 2e-5 for step in steps
    ]
    assert process.objective(theta, kept)[1] == pytest.approx(differences, rel=1e-4, abs=1e-4)


def test_a_feature_that_tells_helps_and_a_permuted_one_does_not():
    rng = np.random.default_rng(2)
    exams, features = exams_of(rng, 80)
    truth = exams.mean(features[:, 0] + np.sin(2 * features[:, 1])) + 0.05 * rng.standard_normal(80)
    without, _, _ = left_out(Exams(features[:, [0, 2]], exams.body), truth)
    permuted = rng.permutation(features[:, 1])
    control, _, _ = left_out(Exams(np.c_[features[:, [0, 2]], permuted], exams.body), truth)
    helped, sd, _ = left_out(Exams(features[:, [0, 2, 1]], exams.body), truth)
    assert helped.std() < 0.6 * without.std()
    assert control.std() > 0.9 * without.std()
    assert 0.7 < (helped / sd).std() < 1.4


def head_frames(bump: Bump, rng: np.random.Generator, *, noise: float) -> HeadFrames:
    """Frames that the expansion's own functions made, on a head that is not flat."""
    x, y = (PITCH_MM * (np.arange(size) - (size - 1) / 2) for size in SHAPE)
    lump = np.stack([rng.uniform(-19, 19, 300), rng.uniform(-15, 15, 300)], axis=-1)
    offset = np.stack(np.broadcast_arrays(x[:, None], y), axis=-1)[None] - lump[:, None, None]
    away = offset.reshape(300, -1, 2) / SIGMA_MM
    columns = expansion_columns(away[..., 0], away[..., 1], lump / (0.5 * PITCH_MM * np.array(SHAPE)))
    added = bump.amplitude * np.tensordot(TRUE, columns, axes=1).reshape(300, *SHAPE)
    free = 1.0 + 0.2 * (x[:, None] / 12) ** 2 + 0.1 * (y / 19.5) ** 2
    level = rng.uniform(7, 11, 300)
    kpa = level[:, None, None] * (free + added + noise * rng.standard_normal(added.shape))
    unit = bump.at(offset + bump.centre_mm)
    none = np.zeros(0)
    return HeadFrames(kpa, kpa.mean(axis=(1, 2)), lump, none, unit, offset, free, level, none, none)


@pytest.mark.parametrize(("amplitude", "within"), [(1.0, 0.02), (0.05, 1.0)])
def test_the_six_figures_come_back(amplitude, within):
    rng = np.random.default_rng(3)
    bump = Bump(amplitude, np.zeros(2), SIGMA_MM, np.zeros(0))
    found = expansion(head_frames(bump, rng, noise=0.01), bump)
    assert [found[name] for name in CHOSEN] == pytest.approx(TRUE, abs=within)


def test_without_a_lump_the_figures_are_the_usual_ones_scaled_down():
    """Negative control: frames of the head alone have nothing that follows the lump's place."""
    rng = np.random.default_rng(4)
    bump = Bump(1.0, np.zeros(2), SIGMA_MM, np.zeros(0))
    frames = head_frames(Bump(0.0, np.zeros(2), SIGMA_MM, np.zeros(0)), rng, noise=0.01)
    assert max(map(abs, expansion(frames, bump).values())) < 0.05
