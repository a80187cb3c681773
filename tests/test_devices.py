"""Two devices of one machine: the same designs bit for bit, the same integrals to roundoff."""

import os
import subprocess
import sys

SCRIPT = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
import jax.numpy as jnp
import numpy as np
import pk_jax as pk
from pk_jax.design import search

pk.enable_x64()


class Ball(pk.Mechanism):
    radius: jax.Array

    def residual(self, pose, joints):
        return pose - joints

    def home(self):
        return jnp.zeros(3), jnp.zeros(3)

    def length(self):
        return jnp.ones(())

    def inverse(self, pose, branch=None, *, free=None):
        return pose

    def margins(self, pose, joints):
        return {"inside": (self.radius**2 - pose @ pose)[None], "below": (0.5 - pose[2])[None]}

    def skeleton(self, pose, joints):
        return pk.Skeleton(pose[None], ())


first, second = jax.devices()
height = lambda mech, pose, joints: pose[2]
of = lambda devices: pk.workspace_integral(
    Ball(radius=1.5), height, rule="rays", rays=300, replicates=4, devices=devices)
alone, shared = of(None), of((first, second))
assert alone.status == shared.status == 0
magnitudes = 4 * np.pi / 3 * 1.5**3  # of the volume, and more than that of the heights
off = np.abs(np.asarray(alone.replicates - shared.replicates))
assert np.all(off <= 8 * 2.2e-16 * magnitudes * 1.5), off
cap = np.pi * 1.0**2 * (3 * 1.5 - 1.0) / 3  # of height 1
assert abs(shared.volume - (magnitudes - cap)) <= shared.error.volume, shared

problem = pk.DesignProblem(
    lambda v: Ball(radius=v["radius"] + 0 * v["other"]), {"radius": (1.0, 2.0), "other": (0.0, 1.0)},
    lambda mech: jnp.sin(3 * mech.radius))
vectors = 1 + np.arange(40.0).reshape(20, 2) / 40
one, two = (pk.evaluate_designs(problem, vectors, devices=d) for d in ([first], [first, second]))
for a, b in zip(one, two, strict=True):
    np.testing.assert_array_equal(a, b)
boxes = np.linspace(0, 1, 74).reshape(37, 2)
starts = search.begin(problem, boxes)
one, two = (search.advance(problem, starts, 20, devices=d) for d in ([first], [first, second]))
for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
    np.testing.assert_array_equal(a, b)
print("the same")
"""


def test_two_devices_give_the_answers_of_one():
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environment, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split("\n")[-2] == "the same"
