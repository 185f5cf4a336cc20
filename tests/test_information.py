"""The study of what frames tell: its regression, against what is known by construction."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.information_gp import BodyProcess, Exams, left_out


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
