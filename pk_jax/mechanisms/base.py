"""The contract of a mechanism.

A mechanism says only what is particular to it: its geometry (the fields) and ONE constraint
residual. Every analysis is a free function whose first argument is a mechanism. Subclassing
`Mechanism` turns the class into a frozen keyword-only dataclass and a JAX pytree whose leaves are
the geometry, so `jax.grad(f)(mechanism)` is itself a mechanism: one of gradients.

All methods are written for ONE configuration; callers vmap.
"""

from __future__ import annotations

import abc
import dataclasses
import typing
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.geometry.poses import place, place_jacobian, retract, tangent_size, tangent_zero
from pk_jax.mechanisms.declared import check_attributes, check_fields, require_complete


class Skeleton(NamedTuple):
    """A mechanism as a drawing: points, and the index pairs that bars connect."""

    points: jax.Array  # (p, 2) or (p, 3)
    segments: tuple[tuple[int, int], ...]
    ground: tuple[int, ...] = ()  # the points that stand on the base


@typing.dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False)
class Mechanism(abc.ABC):
    """Base class of every mechanism; see CONTRIBUTING for a complete example.

    Symbols used throughout: pose x with n tangent coordinates, joints q (m,), residual F (c,),
    A = dF/dx (c, n), B = dF/dq (c, m), c >= n.
    """

    joint_units: ClassVar[tuple[int, ...] | None] = None  # 1 = length, 0 = angle; None = all lengths
    pose_units: ClassVar[tuple[int, ...] | None] = None  # the same for the tangent of an array pose
    angles_come_round: ClassVar[bool] = True  # those of the pose: a full turn is none
    joints_are_distances: ClassVar[bool] = False  # joints that are not positive make no sense
    actuated_rows: ClassVar[int | None] = None  # the first so many equations carry force (others: sensors)
    free_joints: ClassVar[int] = 0  # the last so many joints: a pose leaves them free (kinematic redundancy)
    joint_names: ClassVar[tuple[str, ...] | None] = None  # for files; default: q1, q2, ... or l1, l2, ...

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        check_attributes(cls)
        dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)(cls)
        names = tuple(field.name for field in dataclasses.fields(cls))
        check_fields(cls, names)

        keys = tuple(map(jax.tree_util.GetAttrKey, names))

        def flatten(mechanism):  # without the keys: this one is called for every jitted call
            fields = mechanism.__dict__
            return [fields[name] for name in names], None

        def flatten_with_keys(mechanism):
            return tuple(zip(keys, flatten(mechanism)[0], strict=True)), None

        def unflatten(_, leaves):  # JAX rebuilds with tracers: only callers meet __post_init__
            mechanism = object.__new__(cls)
            for name, leaf in zip(names, leaves, strict=True):
                object.__setattr__(mechanism, name, leaf)
            return mechanism

        jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)

    def __new__(cls, *values: Any, **fields: Any) -> Mechanism:
        require_complete(cls)
        if values:
            named = ", ".join(f"{field.name}=..." for field in dataclasses.fields(cls))
            raise TypeError(f"{cls.__name__} takes its geometry by name: {cls.__name__}({named})")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None or field.default is not None:  # None only where it is the default
                array = checks.real_array(f"{type(self).__name__}.{field.name}", value)
                object.__setattr__(self, field.name, array)
        self.check_shapes()
        if self.actuated_rows is not None:
            self._check_actuated_rows()
        if checks.is_concrete(self):
            with checks.known_values():
                for field in dataclasses.fields(self):
                    if (value := getattr(self, field.name)) is not None:
                        checks.is_finite(f"{type(self).__name__}.{field.name}", value)
                self.check_values()

    def _check_actuated_rows(self) -> None:
        freedoms = tangent_size(jax.eval_shape(lambda mech: mech.home()[0], self))
        if self.actuated_rows < freedoms:
            raise ValueError(
                f"{type(self).__name__}.actuated_rows must be at least {freedoms}, the coordinates of its "
                f"pose, got {self.actuated_rows}: equations of constraints carry force, too"
            )

    def __repr__(self) -> str:
        def show(value):
            return np.asarray(value).tolist() if isinstance(value, jax.Array) else value

        fields = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        inside = ", ".join(
            f"{name}={value if not checks.is_concrete(value) else show(value)}" for name, value in fields
        )
        return f"{type(self).__name__}({inside})"

    def check_shapes(self) -> None:
        """Raise ValueError where a field has the wrong shape. Always called."""

    def check_values(self) -> None:
        """Raise ValueError where a geometry is impossible. Called only on known values."""

    @abc.abstractmethod
    def residual(self, pose: Any, joints: jax.Array) -> jax.Array:
        """The closure equations F(x, q; geometry), zero on a configuration. -> (c,)"""

    @abc.abstractmethod
    def home(self) -> tuple[Any, jax.Array]:
        """A regular reference configuration, the pose under stop_gradient. -> (pose, joints)"""

    @abc.abstractmethod
    def length(self) -> jax.Array:
        """A characteristic length. -> () m"""

    @abc.abstractmethod
    def margins(self, pose: Any, joints: jax.Array) -> dict[str, jax.Array]:
        """Named, dimensionless distances to the limits, >= 0 inside; {} where none are known."""

    def default_branch(self) -> jax.Array | None:
        """The working mode, a vector of signs, that `inverse` takes where none is given. -> (s,)

        None: the closed form has a single mode.
        """
        return None

    def free_range(self) -> jax.Array:
        """Least and greatest value of each of the free joints, of mechanisms that have some. -> (k, 2)"""
        raise ValueError(f"{type(self).__name__} has free_joints and must define free_range()")

    def prepared(self) -> Mechanism:
        """The same mechanism with what follows from its geometry alone computed once, for long integrals."""
        return self

    @abc.abstractmethod
    def skeleton(self, pose: Any, joints: jax.Array) -> Skeleton:
        """What to draw."""

    # Optional: a mechanism with a closed form defines
    #     inverse(pose, branch=None, *, free=None) -> joints, NaN where unreachable; free: values
    #         (free_joints,) of the kinematically redundant joints, home's where there are none
    #     forward(joints) -> (poses, is_real), every assembly mode, fixed shape

    def linearize(self, pose: Any, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """F and A = dF/dx in the tangent of the pose. -> (c,), (c, n)"""

        def moved(twist):
            value = self.residual(retract(pose, twist), joints)
            return value, value

        jacobian, value = jax.jacfwd(moved, has_aux=True)(tangent_zero(pose))
        return value, jacobian


class LegMechanism(Mechanism):
    """A mechanism whose legs each see ONE platform point.

    It states `attachments` and `legs`; the residual and its linearization follow. The gradient of
    a leg's equation with respect to its platform point is the force of the leg's wrench line, so
    one vector-Jacobian product gives all of them, and the rigid-body map turns them into A.
    """

    @abc.abstractmethod
    def attachments(self) -> jax.Array:
        """Where the legs meet the platform, in the platform frame. -> (k, d)"""

    @abc.abstractmethod
    def legs(self, points: jax.Array, joints: jax.Array) -> jax.Array:
        """Closure of every leg; row i sees points[i] (d,) only. -> (k,) or (k, e)"""

    def residual(self, pose: Any, joints: jax.Array) -> jax.Array:
        return self.legs(place(pose, self.attachments()), joints).reshape(-1)

    def linearize(self, pose: Any, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, forces = self.forces(pose, joints)
        rows = jnp.einsum("ekd,kdn->ken", forces, place_jacobian(pose, self.attachments()))
        return value.reshape(-1), rows.reshape(-1, rows.shape[-1])

    def forces(self, pose: Any, joints: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Closure of every leg, and its gradient in the platform point: a force. -> (k, e), (e, k, d)"""
        points = place(pose, self.attachments())
        value, pull_back = jax.vjp(lambda p: self.legs(p, joints).reshape(points.shape[0], -1), points)
        equations = value.shape[1]  # a leg
        seeds = jnp.broadcast_to(jnp.eye(equations, dtype=value.dtype)[:, None], (equations, *value.shape))
        return value, jax.vmap(lambda seed: pull_back(seed)[0])(seeds)


def require_mechanism(function: str, mech: Any) -> None:
    """ValueError, naming the function that was called, where `mech` is no mechanism."""
    if not isinstance(mech, Mechanism):
        raise ValueError(f"{function} takes a pk_jax.Mechanism, got {type(mech).__name__}")
