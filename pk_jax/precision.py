"""float64 is the caller's decision; importing pk_jax never makes it."""

from __future__ import annotations

import jax


def enable_x64() -> None:
    """Switch JAX to float64 for the whole process. Call it before the first array is made."""
    jax.config.update("jax_enable_x64", True)
