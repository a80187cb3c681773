"""A million random poses of every published Stewart platform, there and back."""

import os

import numpy as np
import pytest
from test_forward_rows import RANGES, lengths, sides, some_poses

import pk_jax as pk
from pk_jax import Status
from pk_jax.mechanisms.catalogue import CATALOGUE

ROWS = int(os.environ.get("PK_SOAK_ROWS", 1_000_000))
BLOCK = 100_000
SURE = {"semi-regular-stewart"}  # every pose in RANGES comes back as itself, unless beyond a singularity


@pytest.mark.soak
@pytest.mark.parametrize("name", [name for name in CATALOGUE if not name.startswith("nam-")])
def test_a_million_poses_there_and_back(name):
    """A row that is OK meets its lengths, on the side it says; another pose than meant is another mode."""
    mech = pk.catalogued(name)
    base = np.asarray(mech.base)
    size = np.sqrt(np.mean(np.sum((base - base.mean(axis=0)) ** 2, axis=1)))
    missed = 0
    for seed in range(-(-ROWS // BLOCK)):
        poses = some_poses(mech, min(ROWS, BLOCK), RANGES, seed)
        joints = lengths(mech, poses)
        found = pk.forward_kinematics(mech, joints)
        is_ok = np.asarray(found.status) == Status.OK
        pose = found.pose[np.flatnonzero(is_ok)]
        np.testing.assert_allclose(lengths(mech, pose), joints[is_ok], rtol=0, atol=1e-12 * size)
        gram = np.einsum("rij,rkj->rik", pose.rotation, pose.rotation)
        np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), rtol=0, atol=1e-13)
        np.testing.assert_array_equal(np.asarray(found.det_sign)[is_ok], sides(mech, pose))
        np.testing.assert_array_equal(np.asarray(found.det_sign)[is_ok], 1)
        assert np.all(np.asarray(found.sigma_min)[is_ok] > 0)
        assert np.all(np.isnan(np.asarray(found.pose.rotation)[~is_ok]))
        gap = np.abs(np.asarray(found.pose.translation) - poses.translation).max(axis=1) / size
        turn = np.abs(np.asarray(found.pose.rotation) - poses.rotation).max(axis=(1, 2))
        is_itself = np.maximum(gap, turn) <= 1e-6  # False for NaN
        is_home_side = sides(mech, poses) > 0
        assert not np.any(is_itself & ~is_home_side)
        missed += np.sum(is_home_side & ~is_itself)
    if name in SURE:
        assert missed == 0
