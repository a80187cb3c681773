"""pk-jax: parse, call one function, print or save. Each verb stands beside its options.

Exit codes: 0 good, 2 bad input, 3 rows that are not OK (--strict), 4 file system, 5 numerical stop,
130 interrupted.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

BAD_INPUT, NOT_OK, FILE_SYSTEM, NUMERICAL, INTERRUPTED = 2, 3, 4, 5, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    from pk_jax.cli.parser import parsed

    options = parsed(sys.argv[1:] if arguments is None else arguments)
    try:
        with _plain_warnings(), _stopped_by_signals():
            code = options.run(options)
            sys.stdout.flush()
            return code
    except ValueError as error:
        return _fail(BAD_INPUT, str(error))
    except BrokenPipeError:  # the reader of our output has gone, e.g. `| head`
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f": {error.filename}" if error.filename else ""
        return _fail(FILE_SYSTEM, f"{error.strerror or error}{where}")
    except FloatingPointError as error:
        return _fail(NUMERICAL, str(error))
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            return _fault(error)
        return _fail(BAD_INPUT, f"not enough memory, ask for less: {str(error)[:200]}")
    except KeyboardInterrupt:
        return _fail(INTERRUPTED, "interrupted")
    except Exception as error:
        return _fault(error)


def _fault(error: Exception) -> int:
    """An error of a user's Python file is told in a line; one of ours is raised."""
    if (read := sys.modules.get("pk_jax.files.python_file")) and (said := read.fault_in(error)):
        return _fail(BAD_INPUT, said)
    raise error


def _fail(code: int, message: str) -> int:
    print(f"pk-jax: {' '.join(message.split())}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings in one line, each kind once."""
    said = set()

    def show(message, category, filename, lineno, *_):
        if (filename, lineno) not in said:
            said.add((filename, lineno))
            print(f"pk-jax: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextlib.contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """What ends the process otherwise ends it as Ctrl-C does: temporary files are taken away."""

    def stop(*_):
        raise KeyboardInterrupt

    before = {}
    with contextlib.suppress(ValueError):  # signals belong to the main thread
        for each in (signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(each) == signal.SIG_DFL:  # `nohup` ignores SIGHUP
                before[each] = signal.signal(each, stop)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


# --- what the verbs need


def begin():
    """What every computing command needs: float64, a compile cache of its own, a progress line."""
    from pk_jax.files.progress import Progress
    from pk_jax.precision import enable_x64

    enable_x64()
    _compile_cache()
    return Progress()


def _compile_cache() -> None:
    """Keep compiled functions between runs, where only the user can write: a cache is code."""
    import jax

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pk_jax"
    with contextlib.suppress(OSError, RuntimeError):
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        if (state := cache.stat()).st_uid == os.getuid() and not state.st_mode & 0o077:
            jax.config.update("jax_compilation_cache_dir", str(cache))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
