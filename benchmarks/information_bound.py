r"""How well the frames of an exam could tell a lump's size if the simulation were the truth: a lower bound of errors.

The posterior covariance of the body's properties by linearising the frames about the truth, with a normal prior of the
population's variances: :math:`(\Lambda + \sum_f J_f^T N_f^{-1} J_f)^{-1}`. Noise of the taxels, errors of their gains,
and errors of each frame's place and tilt are in N; where the lump lies, and height and slope of the skin, are unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tactile_bayes.forward.instrument import frame_times, head_positions, level_kpa
from tactile_bayes.forward.population import BodyPrior
from tactile_bayes.forward.scene import Scene, rotation_from_vector
from tactile_bayes.forward.solid.scan import frames_at_poses
from tactile_bayes.forward.tissue import fat_thickness
from tactile_bayes.geometry import FloatArray

PROPERTIES = ("ln d_mm", "depth_ratio", "ln stiffness_ratio", "seat", "ln fat_kpa", "ln gland_ratio", "thickness_mm")
STEPS = (0.03, 0.03, 0.1, 0.06, 0.05, 0.05, 2.0)
"""Differences are taken over these, either side; where the ends of the population's range allow."""
MOVES = ((0.3, 0.0, 0.0, 0.0), (0.0, 0.3, 0.0, 0.0), (0.0, 0.0, 0.005, 0.0), (0.0, 0.0, 0.0, 0.005))
"""Of a frame's place in mm (across, along) and tilts in radians."""
FLAT_SD = 1e3


def changed(scene: Scene, number: int, step: float) -> Scene:
    """The scene with one property of body or lump changed."""
    lump, body = scene.solid_lumps[0], scene.body
    assert body is not None
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
    lump_kpa : (n, t) array
        What the lump adds to them.
    by_property : (n, t + 1, 7) array
        Change per unit of each of `PROPERTIES`; the last row is the head's depth in mm.
    by_move : (n, t + 1, 4) array
        Change per mm and radian of `MOVES`.
    place_mm : (n, 2) array
        Of the head from the lump, in the scene's plane.
    level_kpa : (n,) array
    scene
        Its noise.
    every
        Frames for each that was computed.
    """

    kpa: FloatArray
    lump_kpa: FloatArray
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
        both: FloatArray = np.c_[kpa.reshape(len(kpa), -1), depth]
        return both

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
    lump, body = scene.solid_lumps[0], scene.body
    assert body is not None
    plain = replace(scene, solid_lumps=(), body=replace(body, fat_mm=fat_thickness(body, scene.solid_lumps)))
    added = here[:, :-1] - felt(plain, rotation, origin)[:, :-1]
    place = origin[:, :2] - np.array([lump.x_mm, lump.y_mm])
    return Exam(here[:, :-1], added, properties, moves, place, level, scene, every)


def _ends(scene: Scene, number: int, step: float) -> tuple[float, float]:
    """Steps down and up; none down from a seat of 0 or a breast without room."""
    if PROPERTIES[number] == "seat":
        seat = scene.solid_lumps[0].seat or 0.0
        return (max(-step, -seat), step)
    if PROPERTIES[number] == "thickness_mm":
        return (0.0, 2 * step)
    return (-step, step)


def posterior_sd(
    exams: Sequence[Exam], *, depth: bool = True, frames: bool = True, model_share: float = 0.0, gain_share: float = 0.0
) -> FloatArray:
    """Posterior SD of `PROPERTIES` from exams of one body.

    Parameters
    ----------
    exams
        Of one body.
    depth, frames
        Which of the data are used: the head's depth as the tracker has it, and the taxels' pressures.
    model_share
        How far real frames may differ from the model, as a share of what the lump adds: SD of each of 27 smooth
        patterns over the head and over the lump's place, another draw for each exam.
    gain_share
        SD of errors of the taxels' gains beside the scene's own: a head or a body whose own frame is not the model's.
    """
    information = np.diag(prior_sd() ** -2.0)
    for exam in exams:
        information = information + _information(exam, depth, frames, model_share, gain_share)
    found: FloatArray = np.sqrt(np.diag(np.linalg.inv(information)))
    return found


def _information(exam: Exam, depth: bool, frames: bool, model_share: float, gain_share: float) -> FloatArray:
    """(7, 7) what an exam adds to the inverse covariance; the unknowns beside the properties are eliminated."""
    noise, (n, t), k = exam.scene.noise, exam.kpa.shape, len(PROPERTIES)
    patterns = _patterns(exam) if model_share else np.zeros((n, t, 0))
    unknown = k + 5 + patterns.shape[2] + t
    full = np.zeros((unknown, unknown))
    weight = np.r_[
        np.full(t, exam.every / noise.element_kpa**2 if frames else 0.0),
        exam.every / noise.tracker_mm**2 if depth else 0.0,
    ]
    moves = np.r_[[noise.tracker_mm**2] * 2, [np.radians(noise.tracker_deg) ** 2] * 2] / exam.every
    for f in range(n):
        design = np.zeros((t + 1, unknown))
        design[:, :k] = exam.by_property[f]
        # the lump's place is the place of all frames; height and slopes of the skin add to the depth
        design[:, k : k + 2] = exam.by_move[f, :, :2]
        design[t, k + 2 : k + 5] = 1.0, *(exam.place_mm[f] / 30.0)
        design[:t, k + 5 : unknown - t] = patterns[f]
        design[:t, unknown - t :] = np.diag(exam.kpa[f])
        shift, scaled = exam.by_move[f], design * weight[:, None]
        inner = np.diag(1.0 / moves) + shift.T @ (shift * weight[:, None])
        cross = shift.T @ scaled
        full += design.T @ scaled - cross.T @ np.linalg.solve(inner, cross)
    gains = np.hypot(noise.gain_share, gain_share)
    shares = np.full(patterns.shape[2], model_share or 1.0)
    full += np.diag(np.r_[np.zeros(k), np.r_[np.full(5, FLAT_SD), shares, np.full(t, gains)] ** -2.0])
    own, others = slice(0, k), slice(k, unknown)
    return np.asarray(full[own, own] - full[own, others] @ np.linalg.solve(full[others, others], full[others, own]))


def _patterns(exam: Exam) -> FloatArray:
    """(n, t, 27) the lump's share times cosines over the head and powers of the lump's place across and along it."""
    head = exam.scene.head
    rows, columns = (
        np.cos(np.pi * np.outer(np.arange(size) + 0.5, range(3)) / size) for size in (head.rows, head.columns)
    )
    over = np.einsum("ra,cb->rcab", rows, columns).reshape(exam.kpa.shape[1], 9)
    square = np.minimum((exam.place_mm / (0.5 * head.pitch_mm * np.array([head.rows, head.columns]))) ** 2, 2.0)
    by_place = np.c_[np.ones(len(square)), square]
    patterns: FloatArray = np.einsum("nt,tj,nk->ntjk", exam.lump_kpa, over, by_place).reshape(*exam.kpa.shape, -1)
    return patterns
