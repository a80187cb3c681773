"""The laws hold for our mechanisms and for the outsiders', and each finds the fault it is for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from outsiders import delta, three_legs, three_rpr

import pk_jax as pk
from pk_jax.kinematics import laws

GOOD = {
    "2-RPR": lambda: pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0),
    "2-RPR, in micrometres, long legs": lambda: pk.TwoRPR(half_base=150e3, l_min=20e3, l_max=4e6),
    "2-RRR, the paper's optimum": lambda: pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15),
    "2-RRR, in mm, long driven links": lambda: pk.FiveBar(half_base=85.0, proximal=900.0, distal=140.0),
    "2-RRR, tiny, arms just meet": lambda: pk.FiveBar(half_base=1e-5, proximal=1.1e-6, distal=1.05e-5),
    "Delta robot": delta,
    "planar 3-RPR": three_rpr,
    "three legs on a point": three_legs,
}


SLOW = {"planar 3-RPR", "Delta robot"}  # to compile; test_planar_robots has one, notebook 02 the other


@pytest.mark.parametrize(
    "build",
    [pytest.param(build, id=name, marks=[pytest.mark.soak] * (name in SLOW)) for name, build in GOOD.items()],
)
def test_laws_hold(build):
    report = pk.check_mechanism(build())
    assert len(report) >= 19
    assert all(np.isfinite(law.error) and law.error <= law.tolerance for law in report)
    assert len(str(report).splitlines()) == len(report)


# ---------------------------------------------------------------- a good mechanism to break


IN_HASTE = pytest.mark.usefixtures("compiled_in_haste")


class Slide(pk.Mechanism):
    """Two crossed slides carry a point: each coordinate is its joint less `gap`."""

    gap: jax.Array

    def residual(self, pose, joints):
        return pose - joints + self.gap

    def home(self):
        pose = lax.stop_gradient(jnp.array([1.0, 2.0], self.gap.dtype))
        return pose, pose + self.gap

    def length(self):
        return jnp.ones((), self.gap.dtype)

    def margins(self, pose, joints):
        return {"right": pose[0], "up": pose[1]}

    def skeleton(self, pose, joints):
        return pk.Skeleton(jnp.stack([jnp.zeros(2), pose]), ((0, 1),), ground=(0,))

    def inverse(self, pose, branch=None, *, free=None):
        return pose + self.gap

    def forward(self, joints):
        return (joints - self.gap)[None], jnp.array([True])


def broken(mech):
    """The one line with which `check_mechanism` refuses it."""
    with pytest.raises(ValueError) as caught:
        pk.check_mechanism(mech)
    said = str(caught.value)
    assert said.startswith(type(mech).__name__) and "\n" not in said
    return said


# ---------------------------------------------------------------- one fault a law


@jax.custom_batching.custom_vmap
def doubled_in_a_batch(x):
    return x


@doubled_in_a_batch.def_vmap
def _(axis_size, is_batched, x):
    return 2 * x, is_batched[0]


@jax.custom_batching.custom_vmap
def mixed_in_a_batch(x):
    return x


@mixed_in_a_batch.def_vmap
def _(axis_size, is_batched, x):
    """Every row feels all the others in its last digits."""
    return x + 1e-13 * jnp.cos(1e6 * lax.stop_gradient(jnp.sum(x))), is_batched[0]


FAULTS = {
    "none": None,
    "open home": "home closes every loop",
    "singular home": "home is regular",
    "home outside": "home is inside every margin",
    "shy inverse": "inverse kinematics is OK near home",
    "wrong inverse": "inverse kinematics is OK near home",
    "another answer in a batch": "a batch equals a loop: inverse kinematics",
    "uphill": "forward kinematics is OK near home",
    "two roots": "forward kinematics of inverse kinematics is the identity",
    "missing mode": "the closed-form modes contain the pose",
    "false mode": "every closed-form mode closes the loops",
    "wrong linearize": "linearize gives dF/dx of the residual",
    "detached pose": "A against central differences",
    "detached joints": "B against central differences",
    "detached inverse": "velocities: A x' + B q' = 0",
    "geometry detached in the residual": "geometry",
    "geometry detached in the inverse": "geometry",
    "rows mixed": "a NaN row changes no other row",
}


def partly_detached(x):
    """x, of which a tenth never reaches the derivative."""
    return 0.9 * x + 0.1 * lax.stop_gradient(x)


class Faulty(Slide):
    """The slide with one fault, chosen by number: a single compilation serves them all."""

    fault: jax.Array

    def when(self, name, wrong, right):
        return jnp.where(jnp.round(self.fault) == list(FAULTS).index(name), wrong, right)

    def residual(self, pose, joints):
        pose = self.when("detached pose", partly_detached(pose), pose)
        joints = self.when("detached joints", partly_detached(joints), joints)
        gap = self.when("geometry detached in the residual", lax.stop_gradient(self.gap), self.gap)
        closed = pose - joints + gap
        u, v = closed
        almost_parallel = jnp.stack([u + v, u + v + 1e-3 * u])
        # as complex numbers z (z - 0.02), z = u + i v: det A > 0 at both of its roots
        product = jnp.stack([u * u - v * v - 0.02 * u, 2 * u * v - 0.02 * v])
        closed = self.when("singular home", almost_parallel, closed)
        closed = self.when("two roots", product, closed)
        return self.when("another answer in a batch", closed * (closed - 1), closed)

    def linearize(self, pose, joints):
        value, a = super().linearize(pose, joints)
        return value, self.when("uphill", -a, self.when("wrong linearize", a * (1 + 1e-6), a))

    def home(self):
        pose, joints = super().home()
        return pose, joints + self.when("open home", 1e-9, 0.0)

    def margins(self, pose, joints):
        return {"right": pose[0], "left": self.when("home outside", 0.9 - pose[0], 1.0)}

    def inverse(self, pose, branch=None, *, free=None):
        pose = self.when("rows mixed", mixed_in_a_batch(pose), pose)
        gap = self.when("geometry detached in the inverse", lax.stop_gradient(self.gap), self.gap)
        right = pose + gap
        joints = self.when("shy inverse", jnp.where(pose < 2.001, right, jnp.nan), right)
        joints = self.when("wrong inverse", right + 1e-6 * (pose - self.home()[0]) ** 2, joints)
        joints = self.when("detached inverse", partly_detached(right), joints)
        other = right + 1 - doubled_in_a_batch(1 + 0 * pose)
        return self.when("another answer in a batch", other, joints)

    def forward(self, joints):
        pose = joints - self.gap
        first = pose + self.when("missing mode", 1e-6, 0.0)
        second = pose + self.when("missing mode", 1e-6, self.when("false mode", 1e-6, 0.0))
        return jnp.stack([first, second]), jnp.array([True, True])


@pytest.mark.soak
@IN_HASTE
def test_the_slide_itself_is_sound():
    assert pk.check_mechanism(Slide(gap=0.25))
    assert pk.check_mechanism(Faulty(gap=0.25, fault=0))


@IN_HASTE
@pytest.mark.parametrize("fault", list(FAULTS)[1:])
def test_a_broken_law_is_named(fault):
    said = broken(Faulty(gap=0.25, fault=list(FAULTS).index(fault)))
    assert FAULTS[fault] in said


class InfiniteDerivative(Slide):
    def inverse(self, pose, branch=None, *, free=None):
        return super().inverse(pose) + jnp.sqrt(self.gap - self.gap)


class HiddenState(Slide):
    """Keeps a part of its geometry outside of the fields, where JAX loses it."""

    def check_values(self):
        object.__setattr__(self, "offset", 1.0)

    def residual(self, pose, joints):
        return super().residual(pose, joints) + getattr(self, "offset", 0.0)

    def home(self):
        pose, joints = super().home()
        return pose, joints + getattr(self, "offset", 0.0)

    def inverse(self, pose, branch=None, *, free=None):
        return super().inverse(pose) + getattr(self, "offset", 0.0)

    def forward(self, joints):
        poses, is_real = super().forward(joints)
        return poses - getattr(self, "offset", 0.0), is_real


@IN_HASTE
@pytest.mark.parametrize(
    ("mechanism", "law"),
    [(InfiniteDerivative, "derivatives in the geometry are finite"), (HiddenState, "pytree")],
)
def test_a_broken_structure_is_named(mechanism, law):
    assert law in broken(mechanism(gap=0.25))


# ---------------------------------------------------------------- laws that only the library can break

LIBRARY = {
    "a NaN row is told": (
        "inverse_kinematics",
        lambda found: found._replace(status=jnp.where(found.status == 9, 0, found.status)),
    ),
    "the derivatives of FK and IK are inverses": (
        "forward_kinematics",
        lambda found: found._replace(pose=1.001 * found.pose - 0.001 * lax.stop_gradient(found.pose)),
    ),
    "a batch equals a loop: forward kinematics": (
        "forward_kinematics",
        lambda found: found._replace(pose=found.pose + 1e-6 * (found.pose.ndim == 1)),
    ),
}


@IN_HASTE
@pytest.mark.parametrize("law", LIBRARY)
def test_a_fault_of_the_solvers_is_named(monkeypatch, law):
    name, change = LIBRARY[law]
    solve = getattr(laws, name)
    monkeypatch.setattr(laws, name, lambda *arguments: change(solve(*arguments)))

    class Fresh(Slide):
        """Known to no cache."""

    assert law in broken(Fresh(gap=0.25))


# ---------------------------------------------------------------- the contract, before any law


class ScalarResidual(Slide):
    def residual(self, pose, joints):
        return jnp.sum(pose - joints)


class ListedResidual(Slide):
    def residual(self, pose, joints):
        return [pose[0] - joints[0] + self.gap, pose[1] - joints[1] + self.gap]


class ListedHome(Slide):
    def home(self):
        return [1.0, 2.0], [1.25, 2.25]


class TooFewEquations(Slide):
    def residual(self, pose, joints):
        return super().residual(pose, joints)[:1]


class ThreeJointUnits(Slide):
    joint_units = (1, 1, 0)


class OnePoseUnit(Slide):
    pose_units = (1,)


class FlatLinearize(Slide):
    def linearize(self, pose, joints):
        value, jacobian = super().linearize(pose, joints)
        return value, jacobian.reshape(-1)


class TransposedForward(Slide):
    def forward(self, joints):
        return (joints - self.gap)[:, None], jnp.array([True])


class ForgetfulForward(Slide):
    def forward(self, joints):
        return (joints - self.gap)[None], jnp.array(True)


class LongInverse(Slide):
    def inverse(self, pose, branch=None, *, free=None):
        return jnp.concatenate([pose, pose])


class VectorLength(Slide):
    def length(self):
        return jnp.ones(2)


class FloatLength(Slide):
    def length(self):
        return 1.0


class NoLength(Slide):
    def length(self):
        return jnp.zeros(())


class ListedMargins(Slide):
    def margins(self, pose, joints):
        return [pose[0], pose[1]]


class FlatSkeleton(Slide):
    def skeleton(self, pose, joints):
        return pk.Skeleton(pose, ())


class LooseBar(Slide):
    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ((0, 1),))


class LooseGround(Slide):
    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], (), ground=(3,))


CONTRACT = [
    (ScalarResidual, "residual"),
    (ListedResidual, "residual"),
    (ListedHome, "home"),
    (TooFewEquations, "residual"),
    (ThreeJointUnits, "joint_units"),
    (OnePoseUnit, "pose_units"),
    (FlatLinearize, "linearize"),
    (TransposedForward, "forward"),
    (ForgetfulForward, "forward"),
    (LongInverse, "inverse"),
    (VectorLength, "length"),
    (FloatLength, "length"),
    (NoLength, "length"),
    (ListedMargins, "margins"),
    (FlatSkeleton, "skeleton"),
    (LooseBar, "skeleton"),
    (LooseGround, "skeleton"),
]


@pytest.mark.parametrize(("mechanism", "method"), CONTRACT, ids=lambda v: getattr(v, "__name__", None))
def test_a_broken_contract_names_the_method(mechanism, method):
    assert broken(mechanism(gap=0.25)).startswith(f"{mechanism.__name__}.{method} ")


@pytest.mark.parametrize("thing", [None, 3, "FiveBar", pk.FiveBar, np.zeros(2)])
def test_only_mechanisms_are_checked(thing):
    with pytest.raises(ValueError, match=r"check_mechanism takes a pk_jax.Mechanism, got "):
        pk.check_mechanism(thing)


def test_an_unfinished_mechanism_cannot_be_made():
    class Unfinished(pk.Mechanism):
        """Lacks all of its methods."""

    with pytest.raises(TypeError, match=r"Unfinished is missing residual\(pose, joints\): .*; skeleton\("):
        Unfinished()
