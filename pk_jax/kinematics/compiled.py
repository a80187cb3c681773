"""Compiling with the options of XLA that pay for lanes.

On a CPU, XLA evaluates shared values again for each output of a fusion (six times the arithmetic, for a
Newton step) and starts every fusion of a loop's body by itself. Two backend options end that. They
would slow other programs down, and `jax.jit` passes on neither, so they are set for these programs alone,
through what `jax.extend` gives. Where that fails, the program is compiled the ordinary way: slower, as right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax.extend import backend


class Options(NamedTuple):
    """How a program of lanes is compiled."""

    width: int | None  # xla_cpu_prefer_vector_width, bits
    extra: tuple[tuple[str, str], ...]  # xla_backend_extra_options
    lanes: int  # of a chunk: as many as keep the intermediate values in the cache


PLAIN = Options(None, (), 512)
WIDE = Options(512, (), 512)
FULL = Options(
    512,
    (("xla_cpu_use_multi_output_fusion", "true"), ("xla_cpu_small_while_loop_byte_threshold", "1000000000")),
    64,
)


def compiled(
    function: Callable, arguments: Any, options: Options = FULL
) -> Callable[[Sequence[jax.Array]], Sequence[jax.Array]]:
    """`function(*arguments)` compiled for arguments of these shapes: leaves in, leaves out."""
    lowered = jax.jit(function, keep_unused=True).lower(*arguments)
    is_cpu = jax.default_backend() == "cpu"
    if is_cpu and options.extra and (program := with_extra_options(lowered, options)) is not None:
        return program
    width = {"xla_cpu_prefer_vector_width": options.width} if is_cpu and options.width else None
    program = lowered.compile(compiler_options=width)
    tree = jax.tree.structure(tuple(arguments))
    return lambda leaves: jax.tree.leaves(program(*jax.tree.unflatten(tree, leaves)))


def with_extra_options(lowered: Any, options: Options) -> Callable | None:
    """Compiled by the client itself; None where this jaxlib does not let us."""
    extra = _serialized(options.extra)
    try:  # only calls that jaxlib makes no promise of
        from jaxlib._jax import DeviceList

        client = backend.get_backend()
        build = backend.get_compile_options(num_replicas=1, num_partitions=1)
        build = type(build).ParseFromString(build.SerializeAsString() + extra)
        build.env_option_overrides = [("xla_cpu_prefer_vector_width", options.width)]
        devices = DeviceList((jax.devices()[0],))
        return client.compile_and_load(str(lowered.compiler_ir("stablehlo")), devices, build).execute
    except (ImportError, AttributeError, TypeError, jax.errors.JaxRuntimeError):
        return None


def _serialized(extra: tuple[tuple[str, str], ...]) -> bytes:
    """CompileOptions.executable_build_options.debug_options.xla_backend_extra_options as protocol buffer.

    Appended to a serialized message, it is merged into it.
    """
    entries = (_field(500, _field(1, key.encode()) + _field(2, value.encode())) for key, value in extra)
    return _field(3, _field(3, b"".join(entries)))


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited field."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
