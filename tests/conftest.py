"""Every test runs in float64; those about float32 say so themselves."""

import os

from hypothesis import HealthCheck, settings

import pk_jax as pk

pk.enable_x64()

settings.register_profile(
    "house",
    deadline=None,  # the first example of a shape compiles
    max_examples=40,
    derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("house")
