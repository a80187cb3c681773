# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # All assembly modes, counted and certified
#
# Six leg lengths do not say where a platform is: a general Stewart platform fits them in 40 ways, complex
# ones counted. Newton's method finds one of them and is silent about the others. `pk.assembly_modes` finds
# all, says whether it did, proves each, and `pk.connect_modes` tells which of them a machine can be in.

# %%
# %matplotlib inline
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import pk_jax as pk
from pk_jax.viz.assembly import draw_modes

pk.enable_x64()  # the caller decides about float64, before the first array

# %% [markdown]
# ## The poses that fit one set of lengths
#
# A semi-regular platform, moved away from home. Forty paths of a parameter homotopy start at the solutions of
# a generic complex platform; every path's fate is told. Twelve of this symmetric geometry go to infinity, so
# that 28 finite solutions remain.

# %%
robot = pk.catalogued("semi-regular-stewart")
pose = pk.SE3.from_rotation_vector([0.1, 0.05, 1.1], [0.2, -0.15, 0.3])
lengths = pk.inverse_kinematics(robot, pose).joints
modes = pk.assembly_modes(robot, lengths)
print(f"{int(modes.count)} poses, complete: {bool(modes.is_complete)}, paths: {modes.tally()}")
assert modes.is_complete and modes.expected == 28

# %%
draw_modes(robot, lengths, modes)

# %% [markdown]
# Base and platform are planar, so every pose has its mirror image in the base. The sign of det A (against its
# sign at home) tells the side of the singularity, `sigma_min` how far that is. The real poses come first, the
# one nearest to home before the others.

# %%
count = int(modes.count)
for k in range(count):
    print(
        f"mode {k + 1}: z {modes.poses.translation[k, 2]:7.4f}, det sign {modes.det_sign[k]:+.0f}, "
        f"sigma_min {modes.sigma_min[k]:.3f}, mirror image {modes.mirror[k] + 1}"
    )
found = np.abs(np.asarray(modes.poses.rotation[:count]) - np.asarray(pose.rotation)).max(axis=(1, 2))
assert found.min() < 1e-12

# %% [markdown]
# ## Proofs
#
# `pk.certify` is Krawczyk's test in interval arithmetic with outward rounding: a true solution of the closure
# equations lies within `radius` of the pose, and no other one within `unique_within`. `assembly_modes` asks
# for it by itself, `forward_kinematics` on request.

# %%
proof = pk.certify(robot, jax.tree.map(lambda leaf: leaf[:count], modes.poses), lengths)
print("certified:", np.asarray(proof.is_certified))
print(f"radius at most {np.max(proof.radius):.1e}, alone within {np.min(proof.unique_within):.1e}")
one = pk.forward_kinematics(robot, lengths, certify=True)
print(f"Newton from home: {pk.Status(int(one.status)).name}, within {float(one.radius):.1e} of a true pose")
off = pk.SE3(pose.translation + 1e-3, pose.rotation)
print("a pose 1 mm beside:", f"{float(pk.certify(robot, off, lengths).radius):.2e}")
assert np.all(proof.is_certified) and one.is_certified

# %% [markdown]
# ## In which of them is the machine?
#
# It was assembled at home and never crosses a type II singularity. A mode on the other side of det A = 0
# cannot be reached; to others a way is sought, and checked. Modes that are linked by a way share a group:
# here all of one sign do, so that the sign of det A alone does not tell the mode. A way's clearance is the
# least singular value of A on it, of which `sigma_min` above is a lower bound.

# %%
links = pk.connect_modes(robot, lengths, modes)
for k in range(count):
    clearance = "" if np.isnan(links.clearance[k]) else f", clearance of the way {links.clearance[k]:.3f}"
    print(f"mode {k + 1}: {pk.Link(int(links.to_home[k])).name}, group {links.group[k]}{clearance}")
assert links.to_home[0] == pk.Link.PATH

# %% [markdown]
# ## Forty real postures
#
# Dietmaier (1998) found a platform of which all forty solutions are real. Each is found, proved and shown.

# %%
dietmaier = pk.catalogued("dietmaier-40")
forty = np.array([1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071])
modes = pk.assembly_modes(dietmaier, forty)
begin = time.perf_counter()
pk.assembly_modes(dietmaier, forty)
print(
    f"{int(modes.count)} poses, certified {np.sum(modes.is_certified)}, {time.perf_counter() - begin:.2f} s"
)
print(f"greatest radius {np.max(modes.radius):.1e}, least sigma_min {np.min(modes.sigma_min):.1e}")
assert modes.count == 40 and np.all(modes.is_certified)

# %%
draw_modes(dietmaier, forty, modes)

# %% [markdown]
# ## How many are real as a rule?
#
# Random platforms at the lengths of a random pose: forty solutions each, few of them real.

# %%
rng = np.random.default_rng(0)
numbers = []
for _ in range(30):
    base, platform = rng.normal(size=(6, 3)), 0.6 * rng.normal(size=(6, 3))
    random_robot = pk.Stewart(base=base, platform=platform)
    at = pk.SE3.from_quaternion(rng.normal(size=3), rng.normal(size=4))
    modes = pk.assembly_modes(random_robot, pk.inverse_kinematics(random_robot, at).joints)
    assert modes.is_complete and modes.expected == 40
    numbers.append(int(modes.count))
fig, ax = plt.subplots(figsize=(5, 3))
ax.bar(*np.unique(numbers, return_counts=True), width=1.2)
ax.set(xlabel="real assembly modes", ylabel="random platforms", title="30 of 30 complete")
plt.show()

# %% [markdown]
# ## Other mechanisms
#
# The same call takes planar mechanisms by their closed forms, and any mechanism at all by a search from many
# starts, which is never called complete.

# %%
planar = pk.catalogued("sauer-3-rpr")  # Sauer, Numerical Analysis: 2, 4 and 6 poses
for p2 in (4, 5, 7):
    modes = pk.assembly_modes(planar, [5, p2, 3])
    print(
        f"3-RPR, p2 = {p2}: {int(modes.count)} poses by {modes.method}, complete: {bool(modes.is_complete)}"
    )
draw_modes(planar, [5, 7, 3], modes)

# %%
casing = pk.catalogued("casing-oscillator")
modes = pk.assembly_modes(casing, casing.home()[1])
print(f"casing oscillator: {int(modes.count)} poses by {modes.method}, {pk.Status(int(modes.status)).name}")
assert not modes.is_complete
