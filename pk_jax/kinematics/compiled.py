"""Compiling for the CPU with the options of XLA that pay for lanes.

By default XLA evaluates shared values again for each output of a fusion (six times the arithmetic, for
a Newton step) and starts every fusion of a loop's body by itself. Two options end that; they would slow
other programs down, and `jax.jit` passes on neither, so they are set for these programs alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend import backend

_WIDTH = "xla_cpu_prefer_vector_width"
_EXTRA = {
    "xla_cpu_use_multi_output_fusion": "true",
    "xla_cpu_small_while_loop_byte_threshold": "1000000000",
}


def compiled(function: Callable, arguments: Any) -> Callable[[Sequence[jax.Array]], Sequence[jax.Array]]:
    """`function(*arguments)` compiled for arguments of these shapes: leaves in, leaves out."""
    lowered = jax.jit(function, keep_unused=True).lower(*arguments)
    if jax.default_backend() == "cpu":
        try:
            return _with_extra_options(lowered)
        except Exception:  # what this needs of jaxlib is no promise of theirs: slower, and as right
            program = lowered.compile(compiler_options={_WIDTH: 512})
    else:
        program = lowered.compile()
    tree = jax.tree.structure(tuple(arguments))
    return lambda leaves: jax.tree.leaves(program(*jax.tree.unflatten(tree, leaves)))


def _with_extra_options(lowered: Any) -> Callable:
    from jaxlib import _jax

    client = backend.get_backend()
    options = backend.get_compile_options(num_replicas=1, num_partitions=1)
    options = type(options).ParseFromString(options.SerializeAsString() + _extra_options())
    options.env_option_overrides = [(_WIDTH, 512)]
    device = _jax.DeviceList((jax.devices()[0],))
    program = client.compile_and_load(str(lowered.compiler_ir("stablehlo")), device, options)
    return program.execute


def _extra_options() -> bytes:
    """CompileOptions.executable_build_options.debug_options.xla_backend_extra_options, serialized.

    Appended to a serialized message, it is merged into it.
    """
    entries = b"".join(_field(500, _field(1, k.encode()) + _field(2, v.encode())) for k, v in _EXTRA.items())
    return _field(3, _field(3, entries))


def _field(number: int, content: bytes) -> bytes:
    """A length-delimited field of a protocol buffer."""
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
