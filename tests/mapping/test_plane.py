"""The plane's moments: those of all taxel centres, exactly additive, anywhere in space."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.errors import BadDataError
from tactile_bayes.geometry import apply, inverse
from tactile_bayes.mapping.cells import FramePoses, HeadMoments, head_moments
from tactile_bayes.scans import HeadGeometry


def curved_head() -> HeadGeometry:
    flat = scans.flat_head(lever_mm=(3.0, -20.0, 80.0))
    surface = flat.surface_mm.copy()
    surface[..., 2] = -(surface[..., 0] ** 2) / 70
    return HeadGeometry(surface, flat.pitch_mm, flat.scanhead_from_tracker)


def some_poses(seed: int, n: int = 40, *, far_mm: float = 0.0) -> FramePoses:
    rng = np.random.default_rng(seed)
    turns = np.array([scans.rotation(rng.normal(0, 8), about=rng.normal(size=3)) for _ in range(n)])
    position = rng.normal(0, 25, (n, 3)) * [1, 0.5, 0.03] + far_mm
    return FramePoses(position, turns, np.ones(n, dtype=bool))


def subset(poses: FramePoses, frames) -> FramePoses:
    return FramePoses(poses.position_mm[frames], poses.rotation[frames], poses.known[frames])


def same(one: HeadMoments, two: HeadMoments) -> bool:
    return one.sums == two.sums


@given(seed=st.integers(0, 999), cut=st.integers(0, 40), far_mm=st.sampled_from([0.0, 1e3, 1e5, -3e6]))
def test_parts_in_any_order_add_to_the_whole_bit_for_bit(seed, cut, far_mm):
    head, poses = curved_head(), some_poses(seed, far_mm=far_mm)
    order = np.random.default_rng(seed).permutation(40)
    whole = head_moments(head, poses)
    assert same(whole, head_moments(head, subset(poses, order[:cut])) + head_moments(head, subset(poses, order[cut:])))


@pytest.mark.parametrize("far_mm", [0.0, 1e5])
def test_the_plane_is_that_of_the_covariance_of_all_taxel_centres(far_mm):
    head, poses = curved_head(), some_poses(1, far_mm=far_mm)
    plane = head_moments(head, poses).plane()
    taxels = apply(inverse(head.scanhead_from_tracker), head.surface_mm.reshape(-1, 3))
    points = (np.einsum("nij,kj->nki", poses.rotation, taxels) + poses.position_mm[:, None] - far_mm).reshape(-1, 3)
    variances, axes = np.linalg.eigh(np.cov(points.T, bias=True))
    assert plane.rms_mm == pytest.approx(np.sqrt(variances[0]), abs=1e-5)
    assert abs(plane.plane_from_base[2, :3] @ axes[:, 0]) == pytest.approx(1.0, abs=1e-9)
    origin = inverse(plane.plane_from_base)[:3, 3]
    assert origin - far_mm == pytest.approx(points.mean(axis=0), abs=1e-4)


def test_unknown_poses_do_not_count():
    head, poses = curved_head(), some_poses(2)
    known = np.arange(40) % 3 > 0
    marked = FramePoses(np.where(known[:, None], poses.position_mm, 1e9), poses.rotation, known)
    assert same(head_moments(head, marked), head_moments(head, subset(poses, known)))


def test_positions_too_far_apart_for_64_bits_are_still_exact():
    head, poses = curved_head(), some_poses(3)
    wide = FramePoses(poses.position_mm * 1e6, poses.rotation, poses.known)
    parts = head_moments(head, subset(wide, slice(20))) + head_moments(head, subset(wide, slice(20, None)))
    assert same(parts, head_moments(head, wide))


def test_the_normal_follows_the_head_turned_upside_down():
    head, poses = scans.flat_head(), some_poses(4)
    over = scans.rotation(180, about=(1, 0, 0))
    up = head_moments(head, poses).plane()
    down = head_moments(head, FramePoses(poses.position_mm, poses.rotation @ over, poses.known)).plane()
    assert down.plane_from_base[2, :3] == pytest.approx(-up.plane_from_base[2, :3], abs=1e-9)
    assert np.linalg.det(down.plane_from_base[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("far_mm", [1e12, -1e12])
def test_a_head_beyond_all_trackers_is_refused(far_mm):
    """From 2^52 steps of 15 nm on the places of the taxels have gaps."""
    with pytest.raises(BadDataError, match=r"the head was 1e\+12 mm from the tracker's base; check the unit"):
        head_moments(curved_head(), some_poses(1, far_mm=far_mm))


def test_no_frame_has_no_moments():
    nothing = FramePoses(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, dtype=bool))
    assert same(head_moments(curved_head(), nothing), HeadMoments())
