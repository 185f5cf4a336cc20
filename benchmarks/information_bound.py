r"""How well the frames of an exam could tell a lump's size if the simulation were the truth: a lower bound of errors.

The posterior covariance of the body's properties by linearising the frames about the truth, with a normal prior of the
population's variances: :math:`(\Lambda + \sum_f J_f^T N_f^{-1} J_f)^{-1}`. Noise of the taxels, errors of their gains,
and errors of each frame's place and tilt are in N; where the lump lies, and height and slope of the skin, are unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.forward.instrument import frame_times, head_positions, level_kpa
from tactile_bayes.forward.population import BodyPrior
from tactile_bayes.forward.scene import Scene, rotation_from_vector
from tactile_bayes.forward.solid.scan import frames_at_poses
from tactile_bayes.geometry import FloatArray

PROPERTIES = ("ln d_mm", "depth_ratio", "ln stiffness_ratio", "seat", "ln fat_kpa", "ln gland_ratio", "thickness_mm")
STEPS = (0.03, 0.03, 0.1, 0.06, 0.05, 0.05, 2.0)
"""Differences are taken over these, either side; where the ends of the population's range allow."""
MOVES = ((0.3, 0.0, 0.0, 0.0), (0.0, 0.3, 0.0, 0.0), (0.0, 0.0, 0.005, 0.0), (0.0, 0.0, 0.0, 0.005))
"""Of a frame's place in mm (across, along) and tilts in radians."""
FLAT_SD = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Posterior SD of each of `PROPERTIES` from some part of an exam's data."""

    sd: Mapping[str, float]


def changed(scene: Scene, number: int, step: float) -> Scene:
    """The scene with one property of body or lump changed."""
    lump, body = scene.solid_lumps[0], scene.body
    assert body is not None and lump.depth_ratio is not None
    name, factor = PROPERTIES[number].removeprefix("ln "), float(np.exp(step))
    if name in ("fat_kpa", "gland_ratio"):
        return replace(scene, body=replace(body, **{name: getattr(body, name) * factor}))
    if name == "thickness_mm":
        return replace(scene, body=replace(body, thickness_mm=body.thickness_mm + step))
    value = getattr(lump, name) or 0.0
    value = value * factor if PROPERTIES[number].startswith("ln") else value + step
    return replace(scene, solid_lumps=(replace(lump, **{name: value}),))


def prior_sd(bodies: BodyPrior | None = None) -> FloatArray:
    """SD of `PROPERTIES` over the population."""
    bodies = bodies or BodyPrior()
    found = []
    for name in PROPERTIES:
        low, high = getattr(bodies, name.removeprefix("ln "))
        found.append((np.log(high / low) if name.startswith("ln") else high - low) / np.sqrt(12.0))
    return np.array(found)


@dataclass(frozen=True, slots=True, eq=False)
class Exam:
    """An exam's noise-free data and how they change.

    Parameters
    ----------
    kpa : (n, t) array
    by_property : (n, t + 1, 7) array
        Change per unit of each of `PROPERTIES`; the last row is the head's depth in mm.
    by_move : (n, t + 1, 4) array
        Change per mm and radian of `MOVES`.
    place_mm : (n, 2) array
        Of the head.
    level_kpa : (n,) array
    scene
        Its noise.
    every
        Frames for each that was computed.
    """

    kpa: FloatArray
    by_property: FloatArray
    by_move: FloatArray
    place_mm: FloatArray
    level_kpa: FloatArray
    scene: Scene
    every: int


def differentiate(scene: Scene, *, every: int = 10) -> Exam:
    """Noise-free frames of a scene and their derivatives, for one frame in `every`."""
    time = frame_times(scene)[every // 2 :: every]
    rotation, origin = head_positions(scene, time)
    level = level_kpa(scene.background, time)

    def felt(one: Scene, turn: FloatArray, place: FloatArray) -> FloatArray:
        kpa, depth = frames_at_poses(one, turn, place, mean_kpa=level)
        return np.c_[kpa.reshape(len(kpa), -1), depth]

    here = felt(scene, rotation, origin)
    by_property = []
    for number, step in enumerate(STEPS):
        ends = _ends(scene, number, step)
        low, high = (felt(changed(scene, number, end), rotation, origin) for end in ends)
        by_property.append((high - low) / (ends[1] - ends[0]))
    by_move = []
    for move in MOVES:
        turned = rotation @ rotation_from_vector(np.array([move[2], move[3], 0.0]))
        moved = felt(scene, turned, origin + np.array([move[0], move[1], 0.0]))
        by_move.append((moved - here) / max(move))
    properties, moves = np.stack(by_property, axis=-1), np.stack(by_move, axis=-1)
    return Exam(here[:, :-1], properties, moves, origin[:, :2], level, scene, every)


def _ends(scene: Scene, number: int, step: float) -> tuple[float, float]:
    """Steps down and up; none down from a seat of 0 or a breast without room."""
    if PROPERTIES[number] == "seat":
        seat = scene.solid_lumps[0].seat or 0.0
        return (max(-step, -seat), step)
    if PROPERTIES[number] == "thickness_mm":
        return (0.0, 2 * step)
    return (-step, step)


def posterior_sd(exams: Sequence[Exam], *, depth: bool = True, frames: bool = True, gains: bool = True) -> FloatArray:
    """Posterior SD of `PROPERTIES` from exams of one body.

    Parameters
    ----------
    exams
        Of one body.
    depth, frames
        Which of the data are used: the head's depth as the tracker has it, and the taxels' pressures.
    gains
        Whether errors of the taxels' gains are unknown.
    """
    information = np.diag(prior_sd() ** -2.0)
    for exam in exams:
        information = information + _information(exam, depth=depth, frames=frames, gains=gains)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def _information(exam: Exam, *, depth: bool, frames: bool, gains: bool) -> FloatArray:
    """(7, 7) what an exam adds to the inverse covariance."""
    noise, n, t = exam.scene.noise, *exam.kpa.shape
    k = len(PROPERTIES)
    unknown = k + 5 + (t if gains else 0)
    full = np.zeros((unknown, unknown))
    weight = np.r_[
        np.full(t, exam.every / noise.element_kpa**2 if frames else 0.0),
        exam.every / noise.tracker_mm**2 if depth else 0.0,
    ]
    moves = np.r_[noise.tracker_mm**2, noise.tracker_mm**2, *[np.radians(noise.tracker_deg) ** 2] * 2] / exam.every
    for f in range(n):
        # the lump's place is the place of all frames; height and slopes of the skin add to the depth
        rest = np.zeros((t + 1, 5))
        rest[:, :2] = exam.by_move[f, :, :2]
        rest[t, 2:] = 1.0, *(exam.place_mm[f] / 30.0)
        design = np.c_[exam.by_property[f], rest]
        if gains:
            design = np.c_[design, np.r_[np.diag(exam.kpa[f]), np.zeros((1, t))]]
        shift = exam.by_move[f]
        scaled = design * weight[:, None]
        inner = np.diag(1.0 / moves) + shift.T @ (shift * weight[:, None])
        cross = shift.T @ scaled
        full += design.T @ scaled - cross.T @ np.linalg.solve(inner, cross)
    loose = np.r_[np.zeros(k), np.full(5, FLAT_SD**-2.0), np.full(t if gains else 0, noise.gain_share**-2.0)]
    full += np.diag(loose)
    own, others = slice(0, k), slice(k, unknown)
    eliminated: FloatArray = full[own, own] - full[own, others] @ np.linalg.solve(full[others, others], full[others, own])
    return eliminated
