"""A platform as its controller meets it: sampled, late, sluggish, noisy, and not quite as drawn."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pk_jax import checks
from pk_jax.kinematics.linear_stage import ROWS
from pk_jax.mechanisms.stewart import LEGS, Stewart


class Plant(NamedTuple):
    """Lengths in the mechanism's unit (the defaults are metres), times in s. Zero switches anything off."""

    period: float = 1e-3  # of sampling
    delay: int = 1  # samples from a measurement to the command that is made of it
    lag: float = 1e-2  # time constant of the actuators, from commanded to actual rate
    rate_limit: float = 0.5  # of every actuator
    noise: float = 1e-5  # standard deviation of every reading, new in every sample
    quantum: float = 1e-6  # of a reading
    encoder_bias: float = 0.0  # standard deviation of each leg's constant error
    sensor_bias: float = 0.0  # the same of the three sensors
    geometry_error: float = 0.0  # of every coordinate of A_i and B_i, of which the controller does not know
    sensor_geometry_error: float = 0.0  # the same of S_j and T_j


IDEAL = Plant(noise=0.0, quantum=0.0)
GREATEST = 1e100  # its square is a number
TINIEST = 1e-9  # standard deviation of the reading of a perfect encoder


class Gains(NamedTuple):
    """PID in leg rates: rate = feed-forward + kp e + ki (integral of e) + kd (rate of e)."""

    kp: float = 40.0  # 1/s
    ki: float = 20.0  # 1/s^2
    kd: float = 0.0
    feed_forward: float = 1.0  # share of the reference's own leg rates
    anti_windup: bool = True  # no integration while it drives an actuator further into its limit


def check_plant(plant: Plant) -> None:
    if not isinstance(plant, Plant):
        raise ValueError(f"plant must be a pk_jax.Plant, got {type(plant).__name__}")
    for name, value in plant._asdict().items():
        if not (checks.is_number(value) and value >= 0):
            raise ValueError(f"plant.{name} must be a finite number >= 0, got {checks.shown(value)}")
        if value > GREATEST:
            raise ValueError(f"plant.{name} must be at most {GREATEST:g}, got {checks.shown(value)}")
    for name in ("period", "rate_limit"):
        if not getattr(plant, name) > 0:
            raise ValueError(f"plant.{name} must be positive, got {getattr(plant, name)}")
    if plant.delay != int(plant.delay) or plant.delay > 1000:
        raise ValueError(f"plant.delay must be a whole number of samples up to 1000, got {plant.delay}")


def check_gains(gains: Gains) -> None:
    if not isinstance(gains, Gains):
        raise ValueError(f"gains must be a pk_jax.Gains, got {type(gains).__name__}")
    if not isinstance(gains.anti_windup, bool | np.bool_ | int | float):
        raise ValueError(f"gains.anti_windup must be true or false, got {checks.shown(gains.anti_windup)}")
    for name in ("kp", "ki", "kd", "feed_forward"):
        if not checks.is_number(value := getattr(gains, name)):
            raise ValueError(f"gains.{name} must be finite, got {checks.shown(value)}")


def checked_key(key: Any) -> jax.Array:
    """One key of jax.random, new style or old."""
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    is_new = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key) and shape == ()
    if not (is_new or (dtype == np.uint32 and shape == (2,))):
        raise ValueError(
            f"key must be one key of jax.random, such as jax.random.key(0), got {type(key).__name__}"
        )
    return key


def white_variances(plant: Any) -> tuple[Any, Any]:
    """Variances of the lengths of a leg and of a sensor, without the constant errors of the encoders.

    A joint's error moves a length by its component along it, differently in every pose; there are two joints.
    """
    read = plant.noise**2 + plant.quantum**2 / 12 + TINIEST**2
    return read + 2 * plant.geometry_error**2, read + 2 * plant.sensor_geometry_error**2


def weights_of(plant: Plant) -> np.ndarray:
    """1 / variance of the nine lengths, from what is known of a plant's errors. -> (9,)"""
    legs, sensors = white_variances(plant)
    variances = np.array([legs + plant.encoder_bias**2, sensors + plant.sensor_bias**2])
    return np.repeat(1 / variances, [LEGS, ROWS - LEGS])


class Errors(NamedTuple):
    """One draw of what stays the same during a run."""

    stewart: Stewart  # as built
    bias: jax.Array  # (k,)


def drawn(key: jax.Array, stewart: Stewart, plant: Any) -> Errors:
    """A machine as built."""
    of_bias, of_base, of_platform = jax.random.split(key, 3)
    rows, dtype = stewart.base.shape[0], stewart.base.dtype
    spread = lambda legs, sensors: jnp.where(jnp.arange(rows) < LEGS, legs, sensors).astype(dtype)
    bias = spread(plant.encoder_bias, plant.sensor_bias) * jax.random.normal(of_bias, (rows,), dtype)
    off = spread(plant.geometry_error, plant.sensor_geometry_error)[:, None]
    built = dataclasses.replace(
        stewart,
        base=stewart.base + off * jax.random.normal(of_base, (rows, 3), dtype),
        platform=stewart.platform + off * jax.random.normal(of_platform, (rows, 3), dtype),
    )
    return Errors(built, bias)


def read(key: jax.Array, lengths: jax.Array, bias: jax.Array, plant: Any) -> jax.Array:
    """What the encoders say of true lengths. -> (k,)"""
    noisy = lengths + bias + plant.noise * jax.random.normal(key, lengths.shape, lengths.dtype)
    quantum = jnp.where(plant.quantum > 0, plant.quantum, 1)
    return jnp.where(plant.quantum > 0, quantum * jnp.round(noisy / quantum), noisy)


def driven(legs: jax.Array, rates: jax.Array, command: jax.Array, plant: Any) -> tuple[jax.Array, jax.Array]:
    """Legs and their rates a period later: a first-order lag, solved exactly. -> (6,), (6,)"""
    lag = jnp.where(plant.lag > 0, plant.lag, 1)
    left = jnp.where(plant.lag > 0, jnp.exp(-plant.period / lag), 0)
    gained = command * plant.period + (rates - command) * plant.lag * (1 - left)
    return legs + gained, command + (rates - command) * left
