"""The singularity analysis of the casing oscillator (Nam, Bae and Park), computed again and judged.

The paper's Jacobian by its eq. (18), the geometric method of its eqs. (28)-(35), its singular poses, and the
proof of its main claim. The exact model is `CasingOscillator`; what is here is written down independently
of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax.analysis.boxes import Certificate
from pk_jax.analysis.certificate import certify_confined, certify_regular
from pk_jax.analysis.singularity import SingularityKind
from pk_jax.geometry.axis_pose import AxisPose
from pk_jax.geometry.poses import place
from pk_jax.kinematics.inverse import inverse_kinematics
from pk_jax.mechanisms.casing_oscillator import LEGS, CasingOscillator

CARRIAGE_OFFSET = (
    0.180  # m; l5 = E - offset, inferred: it makes the strokes of Table 1 agree with one another
)
STROKES = ("stroke_min", "stroke_max")
DEG = np.pi / 180

# --- mobility, eq. (9)


class Joints(NamedTuple):
    """Joints of one kind in the model of Fig. 2."""

    what: str
    count: int
    freedoms: int  # of each


BODIES = 14  # base, platform with casing, 4 legs of two, rod 5, two at B1, the ball that guides the casing
JOINTS = (
    Joints("prismatic: legs 1-4, actuator 5", 5, 1),
    Joints("spherical: B2, B3, b1, b2, b3, b4", 6, 3),
    Joints("revolute: B1, rod 5 to the two legs", 4, 1),
    Joints("spherical: ball of the casing's guide at O", 1, 3),
    Joints("prismatic: casing in its guide", 1, 1),
)
PASSIVE = 3  # turns of legs 2 and 3 about themselves, and the carriage, which a pose leaves free


def mobility(bodies: int, joints: tuple[Joints, ...], passive: int = 0, space: int = 6) -> int:
    """Freedoms by the Chebychev-Gruebler-Kutzbach criterion, eq. (9), without the passive ones."""
    count = sum(each.count for each in joints)
    return space * (bodies - count - 1) + sum(each.count * each.freedoms for each in joints) - passive


# --- Jacobians: the printed one, statics, and the determinant in closed form


def printed_jacobian(
    mech: CasingOscillator, pose: AxisPose, joints: jax.Array, frame: str = "base"
) -> jax.Array:
    """J_b of eq. (18), subscripts restored: diag(l) l' = J_b (z', w), the carriage at rest. -> (4, 4)

    frame: "base", as printed: z' is the velocity of the platform's centre along Z and w in base axes. Eqs.
    (16)-(17) leave out what the slide moves sideways, so it holds for an upright casing only. "casing":
    the same with all vectors in platform axes and z' = s'; there it is exact.
    """
    if frame not in ("base", "casing"):
        raise ValueError(f'frame must be "base" or "casing", got {frame!r}')
    turn = pose.rotation if frame == "casing" else jnp.eye(3, dtype=pose.rotation.dtype)
    legs, points = _legs(mech, pose, joints)
    centre = pose.s * pose.rotation[:, 2] @ turn
    lx, ly, lz = (legs @ turn).T
    x, y, z = centre
    across = jnp.cross((points @ turn) - centre, legs @ turn).T  # b x l
    return jnp.stack([lz, -ly * z + across[0], lx * z + across[1], -lx * y + ly * x + across[2]], axis=1)


def in_tangent(jacobian: jax.Array, pose: AxisPose, frame: str = "base") -> jax.Array:
    """`printed_jacobian` in the tangent (s', w) of the pose, w in base axes, as J_ex is. -> (4, 4)"""
    if frame == "casing":
        return jnp.concatenate([jacobian[:, :1], jacobian[:, 1:] @ pose.rotation.T], axis=1)
    x, y, _ = pose.s * pose.rotation[:, 2]
    of_z = jnp.stack([pose.rotation[2, 2], y, -x, jnp.zeros_like(x)])  # z' = n_z s' + (w x C)_z
    return (
        jnp.concatenate([jnp.zeros_like(jacobian[:, :1]), jacobian[:, 1:]], axis=1) + jacobian[:, :1] * of_z
    )


def statics_matrix(mech: CasingOscillator, pose: AxisPose, joints: jax.Array) -> jax.Array:
    """S of eq. (34), columns (n . u_i, d_i x u_i): force along the axis, moment about O. -> (4, 4)"""
    legs, points = _legs(mech, pose, joints)
    units = legs / jnp.linalg.norm(legs, axis=1, keepdims=True)
    return jnp.concatenate([(units @ pose.rotation[:, 2])[None], jnp.cross(points, units).T])


class Determinants(NamedTuple):
    """det J_ex = 0 by three ways that must agree."""

    numerical: jax.Array  # () det J_b, eq. (21), J_b exact: in the frame of the casing
    geometric: jax.Array  # () (l1 l2 l3 l4) det S, eq. (35)
    closed: jax.Array  # () the polynomial in the entries of the rotation


def determinants(mech: CasingOscillator, pose: AxisPose, joints: jax.Array) -> Determinants:
    """The numerical and the geometric method of the paper, and the closed form."""
    numerical = jnp.linalg.det(printed_jacobian(mech, pose, joints, "casing"))
    geometric = jnp.prod(joints[:LEGS]) * jnp.linalg.det(statics_matrix(mech, pose, joints))
    return Determinants(numerical, geometric, closed_determinant(mech, pose, joints[LEGS]))


def closed_determinant(mech: CasingOscillator, pose: AxisPose, carriage: jax.Array) -> jax.Array:
    """det J_ex of a pose and a carriage E, with R and r the radii and r_ij the rotation. -> ()

    -4 E R r [E s^3 r11 r33 - E r s^2 r13 r33 - E R r^2 r13 r23 r32 - E R r s r32^2 + R r s^2 r21 r32]
    """
    (r11, _, r13), (r21, _, r23), (_, r32, r33) = pose.rotation
    e, s, base, r = carriage, pose.s, mech.base_radius, mech.platform_radius
    first = e * s**3 * r11 * r33 - e * r * s**2 * r13 * r33 - e * base * r**2 * r13 * r23 * r32
    return -4 * e * base * r * (first - e * base * r * s * r32**2 + base * r * s**2 * r21 * r32)


def _legs(mech: CasingOscillator, pose: AxisPose, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Leg vectors l_i and platform joints d_i. -> (4, 3), (4, 3)"""
    points = place(pose, mech.attachments())
    return points - mech.base(joints[LEGS]), points


# --- singular angles


def singular_pitch(mech: CasingOscillator, s: float) -> float:
    """The pitch, at roll 0, at which s cos = r sin; as singular as +-pi/2, whatever yaw, E and R. -> rad"""
    return float(np.arctan2(s, float(mech.platform_radius)))


def singular_roll(mech: CasingOscillator, s: float) -> float:
    """The positive roll, at pitch = yaw = 0, at which s^2 cos = R r sin^2. -> rad"""
    share = s**2 / (float(mech.base_radius) * float(mech.platform_radius))
    return float(np.arccos((np.sqrt(share**2 + 4) - share) / 2))


class Case(NamedTuple):
    """A configuration that is, or is said to be, singular."""

    figure: str
    title: str
    mechanism: CasingOscillator
    pose: AxisPose
    joints: jax.Array
    kind: SingularityKind  # what it is


def singular_cases(mech: CasingOscillator, s: float = 0.48) -> list[Case]:
    """The singular configurations of Figs. 8 and 9 as they are, and where the text says that they are."""
    pitch, roll = singular_pitch(mech, s), singular_roll(mech, s)
    angles = [
        ("8", "pitch", (0, pitch, 0), SingularityKind.TYPE_II),
        ("8", "pitch", (0, np.pi / 2, 0), SingularityKind.TYPE_II),
        ("9", "roll", (roll, 0, 0), SingularityKind.TYPE_II),
        ("", "said to be: pitch", (0, 75 * DEG, 0), SingularityKind.REGULAR),
        ("", "said to be: roll", (np.pi / 2, 0, 0), SingularityKind.REGULAR),
    ]
    found = []
    for figure, what, (a, b, c), kind in angles:
        pose = AxisPose.from_angles(s, a, b, c)
        joints = inverse_kinematics(mech, pose).candidate
        title = f"{what} {max(a, b) / DEG:.2f} deg"
        found.append(Case(figure, title, mech, pose, joints, kind))
    return found


# --- the proof

BOX = {  # holds all that the strokes let the neutral machine reach, whatever its carriage does
    "s": (0.413, 0.543),
    "roll": (-16 * DEG, 16 * DEG),
    "pitch": (-18.5 * DEG, 14.5 * DEG),
    "yaw": (-14 * DEG, 14 * DEG),
}
AT_LEAST = 0.5  # what |det J_ex| / (4 E^2 R r s^3) is proved to exceed


class Proof(NamedTuple):
    """No singularity in a box, and no way out of it."""

    regular: Certificate
    confined: Certificate

    @property
    def is_proved(self) -> bool:
        return self.regular.is_proved and self.confined.is_proved


def prove_regular_workspace(mech: CasingOscillator | None = None, report: Callable | None = None) -> Proof:
    """Prove that the machine meets no singularity wherever its strokes let it go from its neutral pose.

    |det J_ex| / (4 E^2 R r s^3), which is 1 at the neutral pose, exceeds `AT_LEAST` over `BOX` and the whole
    stroke of the carriage; and on no face of `BOX` are all strokes kept, with the carriage anywhere.
    """
    mech = CasingOscillator() if mech is None else mech
    unit = 4 * float(mech.base_radius) * float(mech.platform_radius)
    regular = certify_regular(
        mech,
        BOX | {"E": np.asarray(mech.free_range()[0])},
        scale=lambda v: unit * v[4] ** 2 * v[0] ** 3,
        at_least=AT_LEAST,
        report=report,
    )
    return Proof(regular, certify_confined(mech, BOX, within=STROKES, report=report))


def largest_misprint(mech: CasingOscillator, pose: AxisPose) -> float:
    """How far leg rates of eq. (18), read in base axes, are off at a pure slide: the largest, relative."""
    joints = inverse_kinematics(mech, pose).joints
    exact, printed = (
        in_tangent(printed_jacobian(mech, pose, joints, frame), pose, frame)[:, 0]
        for frame in ("casing", "base")
    )
    return float(jnp.max(jnp.abs(printed / exact - 1)))


def as_dict(certificate: Certificate) -> dict[str, Any]:
    """A certificate as plain numbers."""
    ranges = zip(certificate.names, certificate.lower.tolist(), certificate.upper.tolist(), strict=True)
    return {
        "is_proved": certificate.is_proved,
        "bound": certificate.bound if certificate.is_proved else None,
        "boxes": certificate.boxes,
        "ranges": {name: [low, high] for name, low, high in ranges},
        "unsettled": len(certificate.unsettled[0]),
    }
