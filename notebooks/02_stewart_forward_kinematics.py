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
# # Stewart platforms: a million poses, each with a verdict
#
# Six leg lengths hold a platform in space. The lengths follow from the pose at once; the pose has to be
# solved for from the lengths, and up to forty poses fit. This notebook solves a real controller's log,
# shows what the verdict on every row is good for, differentiates the solution, and follows a path up to a
# singularity that a small residual does not show. (It takes about a minute, most of it compilation.)

# %%
# %matplotlib inline
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import pk_jax as pk

pk.enable_x64()  # the caller decides about float64, before the first array
EXAMPLES = Path(pk.__file__).parents[1] / "examples"

# %% [markdown]
# ## A platform from a file
#
# A TOML file states the family, the unit and the joints; inside everything is metres and radians. `home()`
# is found from the geometry: the platform above the base, parallel to it, away from singularities.

# %%
robot = pk.load_mechanism(EXAMPLES / "hexapod.toml")
home, lengths = robot.home()
print("home at", np.round(home.translation, 4), "m; legs", np.round(lengths, 4), "m")
pk.draw(robot, home, lengths).figure

# %% [markdown]
# ## The log
#
# The log holds the lengths that a controller measured and the pose that it computed from them, with a
# median of 2.5 ms a solve. The geometry was identified from the log (36 parameters), so what remains is the
# rounding of the file and the tolerance of the controller's own iteration.

# %%
log = np.loadtxt(EXAMPLES / "hexapod_log.csv", delimiter=",", skiprows=5)
measured = log[:, 6:12] * 1e-3  # mm -> m
solved = pk.forward_kinematics(robot, measured)  # compiles once, for batches of every size
begin = time.perf_counter()
solved = pk.forward_kinematics(robot, measured)
elapsed = time.perf_counter() - begin
assert np.all(np.asarray(solved.status) == pk.Status.OK)

logged = Rotation.from_euler("XYZ", log[:, 3:6], degrees=True)
off = 1e3 * np.asarray(solved.pose.translation) - log[:, :3]
turned = Rotation.from_matrix(np.asarray(solved.pose.rotation)) * logged.inv()
position, angle = np.linalg.norm(off, axis=1), np.degrees(turned.magnitude())
rms = lambda x: np.sqrt(np.mean(x**2))
print(
    f"{len(log)} rows in {1e3 * elapsed:.1f} ms; RMS difference {rms(position):.4f} mm, {rms(angle):.5f} deg"
)
print(f"the controller: median {np.median(log[:, 12]):.0f} us a row")
assert rms(position) < 0.002 and rms(angle) < 0.001

# %%
figure = Figure(figsize=(8, 2.8), layout="constrained")
for ax, values, unit in zip(
    figure.subplots(1, 2), (1e3 * position, 1e3 * angle), ("um", "mdeg"), strict=True
):
    ax.hist(values, bins=60, color="#0072b2")
    ax.set(xlabel=f"difference to the log ({unit})", ylabel="rows")
figure

# %% [markdown]
# ## One bad row hurts no other
#
# Every row carries one `Status`. A row that is not `OK` has a NaN pose, so that it cannot be used by
# accident; its last iterate stays in `.candidate`.

# %%
spoiled = measured[:6].copy()
spoiled[1, 2] = np.nan
spoiled[3, 0] *= -1
spoiled[4] = [0.05, 0.3, 0.05, 0.3, 0.05, 0.3]  # legs that cannot meet
with_bad = pk.forward_kinematics(robot, spoiled)
print([pk.Status(s).name for s in with_bad.status.tolist()])
good = np.array([0, 2, 5])
assert np.array_equal(with_bad.pose.translation[good], solved.pose.translation[good])

# %% [markdown]
# ## A residual cannot see the assembly mode
#
# Turn the platform far enough and Newton, started at home, ends on another pose that has the same lengths and
# zero residual. `det_sign` tells on which side of the singularity a pose lies, `sigma_min` how far from it. A
# pose on the other side than the start is `OTHER_MODE`; but most far poses have a twin on this side, which
# fits the lengths as well, and that is what Newton finds.

# %%
robot = pk.catalogued("semi-regular-stewart")
yaw, tilt = np.meshgrid(np.deg2rad(np.linspace(-120, 120, 241)), np.deg2rad(np.linspace(0, 60, 121)))
about_z = np.stack([0 * yaw, 0 * yaw, yaw], axis=-1).reshape(-1, 3)
about_x = np.stack([tilt, 0 * yaw, 0 * yaw], axis=-1).reshape(-1, 3)
turn = Rotation.from_rotvec(about_x) * Rotation.from_rotvec(about_z)
poses = pk.SE3(np.tile([0.0, 0.0, 1.0], (yaw.size, 1)), turn.as_matrix())
lengths = pk.inverse_kinematics(robot, poses).joints
found = pk.forward_kinematics(robot, lengths)
status = np.asarray(found.status).reshape(yaw.shape)
apart = np.abs(np.asarray(found.candidate.rotation) - poses.rotation)
far = apart.max(axis=(1, 2)).reshape(yaw.shape) > 1e-6
is_ok = status == pk.Status.OK
verdict = np.select([is_ok & ~far, is_ok & far, status == pk.Status.OTHER_MODE], [0, 1, 2], 3)
names = ["OK, the pose we meant", "OK, another mode on this side", "OTHER_MODE", "not solved"]
print({name: int(np.sum(verdict == i)) for i, name in enumerate(names)})
assert np.all(np.asarray(found.residual)[is_ok.ravel()] < 1e-12)

figure = Figure(figsize=(8, 3.2), layout="constrained")
ax = figure.subplots()
colours = ["#dceaf5", "#e69f00", "#d55e00", "#262626"]
cells = dict(cmap=ListedColormap(colours), vmin=-0.5, vmax=3.5, rasterized=True)
ax.pcolormesh(np.degrees(yaw), np.degrees(tilt), verdict, **cells)
for i, name in enumerate(names):
    ax.plot([], [], "s", color=colours[i], label=name)
ax.set(xlabel="yaw (deg)", ylabel="tilt about x (deg)")
ax.legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
figure

# %% [markdown]
# So an `OK` pose has the given lengths and lies on this side of the singularity; that it is the pose in which
# the machine is, only a path from a known pose can tell.
#
# ## Following a path
#
# Let the platform yaw at constant height. At 90 degrees (Fichter's singularity) all six legs are dependent.
# Started from the pose before, Newton sails on with zero residual, on the wrong branch: the lengths beyond
# 90 degrees are nearly those before it. `track` watches `sigma_min` and stops.

# %%
ramp = np.deg2rad(np.arange(0.37, 130.0))
spin = np.stack([0 * ramp, 0 * ramp, ramp], axis=1)
path = pk.SE3(np.tile([0.0, 0.0, 1.0], (ramp.size, 1)), Rotation.from_rotvec(spin).as_matrix())
lengths = pk.inverse_kinematics(robot, path).joints
followed = pk.track(robot, lengths)
last = int(followed.reached)
print(f"followed to {np.degrees(ramp[last - 1]):.2f} deg, then {pk.Status(int(followed.status[last])).name}")


def yaw_of(pose):
    R = np.asarray(pose.rotation)
    return np.degrees(np.arctan2(R[..., 1, 0], R[..., 0, 0]))


naive, pose = [], robot.home()[0]
for row in np.asarray(lengths):  # what residual tests alone would do
    step = pk.forward_kinematics(robot, row, pose)
    pose = step.candidate
    naive.append((yaw_of(pose), float(step.residual)))
naive = np.array(naive)
print(f"warm-started Newton at 125 deg: yaw {naive[125, 0]:.1f} deg, residual {naive[125, 1]:.0e}")
assert pk.Status(int(followed.status[last])) == pk.Status.SINGULAR and np.degrees(ramp[last - 1]) < 90

figure = Figure(figsize=(8, 3.2), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(np.degrees(ramp), naive[:, 0], color="#d55e00", label="Newton from the pose before")
left.plot(np.degrees(ramp), yaw_of(followed.pose), color="#0072b2", lw=3, label="track")
left.plot([0, 130], [0, 130], ":", color="#262626", label="the truth")
left.set(xlabel="yaw of the platform (deg)", ylabel="yaw found (deg)")
left.legend(frameon=False)
right.semilogy(np.degrees(ramp), followed.sigma_min, color="#0072b2")
right.set(xlabel="yaw of the platform (deg)", ylabel=r"$\sigma_{\min}$ along the track", xlim=(0, 130))
figure

# %% [markdown]
# ## Derivatives through the solver
#
# The pose carries exact derivatives in the lengths and in the geometry, of any order, by the implicit
# function theorem. The first tells how an error of one leg moves the platform, the second which joint must
# be manufactured best.

# %%
home, lengths = robot.home()
position = lambda robot, lengths: pk.forward_kinematics(robot, lengths).pose.translation
by_geometry, by_length = jax.jit(jax.jacrev(position, argnums=(0, 1)))(robot, lengths)
print("metres of height per metre of each leg", np.round(by_length[2], 4))
worst = np.sqrt(np.sum(np.asarray(by_geometry.base) ** 2, axis=(0, 2)))
print("metres of position per metre of each base joint", np.round(worst, 3))
step = 1e-5
moved = lengths + step * np.concatenate([np.eye(6), -np.eye(6)])  # a batch
ahead, behind = np.split(position(robot, moved), 2)
central = (ahead - behind).T / (2 * step)
print("against central differences:", f"{np.abs(central - by_length).max():.0e}")

# %% [markdown]
# ## A robot that nobody here thought of
#
# `examples/delta.py` is a Delta robot in forty lines: a geometry, one residual, a home, a length, margins
# and a drawing. Everything else follows, and `check_mechanism` checks that it does.

# %%
scope = {}
exec((EXAMPLES / "delta.py").read_text(), scope)
delta = scope["Delta"](base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)
print(pk.check_mechanism(delta))

# %%
angles = np.random.default_rng(0).uniform(-0.5, 0.9, (100_000, 3))
found = pk.forward_kinematics(delta, angles)
begin = time.perf_counter()
found = pk.forward_kinematics(delta, angles)
print(f"{len(angles):,} poses in {1e3 * (time.perf_counter() - begin):.0f} ms,", end=" ")
print({pk.Status(s).name: n for s, n in zip(*np.unique(found.status, return_counts=True), strict=True)})
pk.draw(delta, jnp.asarray(found.pose[0]), jnp.asarray(angles[0])).figure
