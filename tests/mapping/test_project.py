"""Where taxels fall on the plane: the same bits for a frame alone and among others."""

from __future__ import annotations

import mapping_scans as scans
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_bayes.errors import BadDataError
from tactile_bayes.forward.scene import Head
from tactile_bayes.geometry import rigid
from tactile_bayes.mapping.cells import FramePoses, Projector
from tactile_bayes.scans import HeadGeometry

# Curved, so that all three of a taxel's coordinates count.
HEAD = HeadGeometry(Head(radius_mm=14.0).surface_mm(), 1.5, rigid(scans.rotation(25, about=(3, 1, 2)), np.full(3, 7.3)))
PLANE = rigid(scans.rotation(40, about=(1, 2, 3)), np.array([12.3, -4.5, 6.7]))


def some_poses(seed: int, *, n: int = 12, away_mm: float = 0.0) -> FramePoses:
    rng = np.random.default_rng(seed)
    turns = np.array([scans.rotation(rng.normal(0, 30), about=rng.normal(size=3)) for _ in range(n)])
    return FramePoses(rng.normal(away_mm, 30, (n, 3)), turns, np.ones(n, dtype=bool))


def projector(cell_mm: float) -> Projector:
    taxels = np.ones(HEAD.shape, dtype=bool)
    taxels[2, 3] = False
    return Projector(HEAD, plane_from_base=PLANE, taxels=taxels, cell_mm=cell_mm)


@given(seed=st.integers(0, 999), cell_mm=st.sampled_from([0.1, 0.37, 1.0, 4.0]), away_mm=st.sampled_from([0.0, -700.0]))
def test_a_frame_alone_falls_into_the_cells_it_falls_into_among_others(seed, cell_mm, away_mm):
    poses, maker = some_poses(seed, away_mm=away_mm), projector(cell_mm)
    together = maker.at(poses)
    for i in range(len(poses.known)):
        alone, among = maker.at(poses.part(slice(i, i + 1))), together.part(slice(i, i + 1))
        np.testing.assert_array_equal(alone.matrix, among.matrix)
        first, shape = alone.block()
        assert (first, shape) == among.block()
        flat = together.part([i, (i + 1) % len(poses.known)]).flat(first, shape)[0]
        np.testing.assert_array_equal(alone.flat(first, shape)[0], flat)
        uv = np.floor(among.matrix[0, :, :3] @ alone.taxels[:3] + among.shift[0][:, None])
        np.testing.assert_array_equal(flat, (uv[1] - first[0]) * shape[1] + uv[0] - first[1])


@pytest.mark.parametrize("place_mm", [1e7, 1e200])
def test_a_frame_far_away_is_refused_alone_as_among_others(place_mm):
    """Where it is projected, nothing is said yet: a frame that the gate drops may be anywhere."""
    near, maker = some_poses(3), projector(1.0)
    far = FramePoses(np.where(np.arange(12)[:, None] == 4, place_mm, near.position_mm), near.rotation, near.known)
    alone = maker.at(far.part(slice(4, 5)))
    np.testing.assert_array_equal(alone.matrix, maker.at(far).part(slice(4, 5)).matrix)
    for projection in (alone, maker.at(far)):
        with pytest.raises(BadDataError, match="cells of 1 mm"):
            projection.block()
