"""Every test runs in float64; those about float32 say so themselves."""

import gc
import os
from pathlib import Path

import jax
import pytest
from hypothesis import HealthCheck, settings

import pk_jax as pk
from pk_jax.cli import main

pk.enable_x64()

settings.register_profile(
    "house",
    deadline=None,  # the first example of a shape compiles
    max_examples=40,
    derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("house")


@pytest.fixture
def run(capsys, monkeypatch):
    """The command line in this process: exit code, stdout, stderr."""
    monkeypatch.setattr("pk_jax.cli._compile_cache", lambda: None)

    def run(*arguments):
        try:
            code = main([str(each) for each in arguments])
        except SystemExit as stop:  # argparse
            code = stop.code
        shown = capsys.readouterr()
        assert "Traceback" not in shown.err
        return code, shown.out, shown.err

    return run


MOST_MAPS = 20_000  # of memory, of the 65,530 of a process on Linux; every compiled program takes some


@pytest.fixture(scope="module", autouse=True)
def programs_do_not_pile_up():
    """A process that has compiled some thousand programs crashes in the compiler for want of maps."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


HASTE = "jax_disable_most_optimizations"


def pytest_configure(config):
    """Most tests compile; without most optimizations XLA is sooner done. It computes the same to roundoff."""
    jax.config.update(HASTE, config.getoption("markexpr") != "soak")


def _compiled(in_haste):
    """No program of the other kind may stay: the next file may compare bits."""
    before = jax.config.read(HASTE)
    if before == in_haste:
        yield
        return
    jax.clear_caches()
    jax.config.update(HASTE, in_haste)
    yield
    jax.config.update(HASTE, before)
    jax.clear_caches()


@pytest.fixture(scope="module")
def compiled_in_haste():
    """For files that mostly compile, also in long runs."""
    yield from _compiled(True)


@pytest.fixture(scope="module")
def compiled_well():
    """For files that mostly run."""
    yield from _compiled(False)
