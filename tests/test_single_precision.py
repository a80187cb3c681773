"""Without float64, as JAX comes: every family answers as well as float32 can, or says that it needs more."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from outsiders import delta
from refusals import said_by

import pk_jax as pk
from pk_jax.geometry.poses import retract, tangent_size
from pk_jax.status import Status

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

SOON = ["4-rrr"]
LATER = [
    "nam-2-rpr",
    "nam-2-rrr",
    "semi-regular-stewart",
    "sauer-3-rpr",
    "3-rrr",
    "6-link",
    "casing-oscillator",
    "delta",
]
NAMES = [*SOON, *(pytest.param(name, marks=pytest.mark.soak) for name in LATER)]


def make(name):
    return delta() if name == "delta" else pk.catalogued(name)


def everything(mech, pose):
    """What a user asks of a configuration."""
    joints = pk.inverse_kinematics(mech, pose).joints
    found = pk.forward_kinematics(mech, joints, pose)
    return {
        "joints": joints,
        "pose": found.pose,
        "A": pk.pose_jacobian(mech, pose, joints),
        "B": pk.joint_jacobian(mech, pose, joints),
        "screws": pk.screws(mech, pose, joints),
        "indices": pk.local_indices(mech, pose),
        "sigma": pk.classify_singularity(mech, pose, joints).sigma_direct,
    }, found.status


@pytest.mark.parametrize("name", NAMES)
def test_float32_is_float64_to_its_own_roundoff(name):
    twist = 0.05 * np.array([0.3, -0.7, 0.5, 0.2, 0.4, -0.6])

    def answers():
        mech = make(name)
        home = mech.home()[0]
        scale = jnp.asarray(mech.length(), jnp.result_type(float))
        pose = retract(home, scale * twist[: tangent_size(home)])
        found, status = jax.jit(everything)(mech, pose)
        assert status == Status.OK
        leaves = map(np.asarray, jax.tree.leaves(found))
        return [leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.floating)]

    exact = answers()
    with jax.enable_x64(False):
        short = answers()
    for each, expected in zip(short, exact, strict=True):
        assert each.dtype == np.float32 and expected.dtype == np.float64
        np.testing.assert_allclose(each, expected, rtol=0, atol=2e-4 * max(1, np.max(np.abs(expected))))


def test_what_needs_float64_says_so():
    with jax.enable_x64(False):
        mech = pk.catalogued("semi-regular-stewart")
        pose, joints = mech.home()
        for call in (pk.certify, pk.assembly_modes):
            arguments = (mech, joints) if call is pk.assembly_modes else (mech, pose, joints)
            assert "enable_x64" in said_by(call, *arguments)
