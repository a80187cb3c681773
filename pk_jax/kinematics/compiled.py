"""Compiling with the options of XLA that pay for lanes.

On a CPU, XLA evaluates shared values again for each output of a fusion, and starts every fusion of a
loop's body by itself. Two backend options end that. They would slow other programs down, and `jax.jit`
passes on neither, so they are set for these programs alone, through what `jax.extend` gives. Where that
fails, the program is compiled the ordinary way: slower, as right.
"""

from __future__ import annotations

import contextlib
import os
import platform
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jaxlib
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
        source = str(lowered.compiler_ir("stablehlo"))
        kept = _kept_file(source, repr(options))
        if (machine_code := _read(kept)) is not None:
            return client.deserialize_executable(machine_code, devices, build).execute
        program = client.compile_and_load(source, devices, build)
        _write(kept, program.serialize())
        return program.execute
    except (ImportError, AttributeError, TypeError, jax.errors.JaxRuntimeError):
        return None


# --- programs kept from run to run, where the user has asked JAX for it (jax_compilation_cache_dir)


def _kept_file(*parts: str) -> Path | None:
    """Where the machine code of this program is kept: by source, options, jaxlib and processor."""
    folder = jax.config.jax_compilation_cache_dir
    if not folder:
        return None
    name = "\n".join((*parts, jaxlib.__version__, _processor()))
    return Path(folder) / f"pk_jax-{sha256(name.encode()).hexdigest()}"


def _read(file: Path | None) -> bytes | None:
    """The content of a whole file; None where there is none or it is damaged."""
    try:
        content = b"" if file is None else file.read_bytes()
    except OSError:
        return None
    digest, content = content[:32], content[32:]
    return content if content and sha256(content).digest() == digest else None


def _write(file: Path | None, content: bytes) -> None:
    if file is None:
        return
    with contextlib.suppress(OSError):  # a cache that cannot be written is none
        handle, temporary = tempfile.mkstemp(dir=file.parent)
        with os.fdopen(handle, "wb") as out:
            out.write(sha256(content).digest() + content)
        os.replace(temporary, file)


@cache
def _processor() -> str:
    """What machine code depends on."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        lines = [line for line in file if line.startswith(("model name", "flags", "Features"))]
        return "".join(sorted(set(lines)))
    return platform.platform() + platform.processor()


# --- options


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
