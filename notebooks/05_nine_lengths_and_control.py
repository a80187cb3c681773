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
# # Nine lengths, and what they do for a control loop
#
# Six leg lengths of a Stewart platform fit up to 40 poses. Three more length sensors, from the base to three
# points of the platform, make the pose unique and give it in closed form: Ryu et al., patent application KR
# 10-2000-0073215. This notebook computes it, finds out which layouts of sensors cannot work, places sensors
# by gradients, closes the patent's control loop, and identifies a geometry from a log.

# %%
# %matplotlib inline
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import pk_jax as pk
from pk_jax.viz.nine_lengths import draw_platform, draw_tracking

pk.enable_x64()  # the caller decides about float64, before the first array

# %% [markdown]
# ## A pose without a guess
#
# The platform has nine rows, six legs and then the sensors. The patent prints no geometry, so this is an
# example; legs black, sensors dashed.

# %%
robot = pk.catalogued("nine-lengths")
draw_platform(robot, *robot.home()).figure

# %% [markdown]
# Poses are tilted up to 40 degrees and turned by any yaw, lengths carry noise of 10 µm. The closed form needs
# no guess; it is then the start of a weighted least-squares estimate on all nine lengths. The pose comes with
# its covariance.

# %%
rng = np.random.default_rng(0)
count, noise = 2000, 1e-5
tilt, way = rng.uniform(0, np.deg2rad(40), count), rng.uniform(0, 2 * np.pi, count)
leaning = pk.SE3.from_rotation_vector(
    rng.uniform([-0.3, -0.3, 0.7], [0.3, 0.3, 1.3], (count, 3)),
    np.stack([tilt * np.cos(way), tilt * np.sin(way), 0 * way], axis=1),
)
yaw = pk.SE3.from_rotation_vector(
    np.zeros((count, 3)), np.outer(rng.uniform(-np.pi, np.pi, count), [0, 0, 1])
)
true = pk.SE3(leaning.translation, leaning.rotation @ yaw.rotation)
lengths = pk.inverse_kinematics(robot, true).joints + noise * rng.standard_normal((count, 9))
found = pk.nine_length_pose(robot, lengths, weights=np.full(9, 1 / noise**2))
distance = lambda pose: np.linalg.norm(pose.translation - true.translation, axis=1)
print(f"rows OK: {np.sum(found.status == pk.Status.OK)} of {count}")
print(f"median error of the closed form {1e6 * np.median(distance(found.closed_form)):.1f} um")
print(f"median error of the estimate    {1e6 * np.median(distance(found.pose)):.1f} um")
predicted = np.sqrt(np.trace(found.covariance[:, :3, :3], axis1=1, axis2=2))
actual = np.sqrt(np.mean(distance(found.pose) ** 2))
print(f"RMS error {1e6 * actual:.1f} um, by its own covariance {1e6 * np.sqrt(np.mean(predicted**2)):.1f} um")
assert np.all(found.status == pk.Status.OK) and np.max(distance(found.pose)) < 10 * predicted.max()

# %% [markdown]
# The mirror image of the pose in the base fits the same lengths: all real candidates, and how far off the
# lengths each is.

# %%
both = pk.nine_length_candidates(robot, pk.inverse_kinematics(robot, robot.home()[0]).joints)
print("z of the candidates", np.round(np.asarray(both.poses.translation[:, 2]), 9))
print("RMS error of their lengths below 1e-12:", np.asarray(both.residual) < 1e-12)

# %% [markdown]
# ## Layouts that cannot work
#
# The closed form starts with six linear equations whose matrix knows no pose. If it is singular, it is so in
# every pose. Legs that meet in pairs at the sensors' joints (6-3), with the sensors' feet on the lines
# between the feet of the pairs, leave rank 3:

# %%
home = np.asarray(robot.platform)
corners, feet = home[6:], np.asarray(robot.base)[:6]
middles = (feet[0::2] + feet[1::2]) / 2
paired = pk.Stewart(
    base=np.concatenate([feet, middles]), platform=np.concatenate([np.repeat(corners, 2, axis=0), corners])
)
for name, each in (("the example", robot), ("6-3, sensors between the feet", paired)):
    layout = pk.sensor_layout(each)
    print(f"{name}: rank {layout.rank} of 6, condition {layout.condition:.3g}")
try:
    pk.nine_length_pose(paired, lengths)
except ValueError as refused:
    print(refused)

# %% [markdown]
# ## Where to put the sensors
#
# How errors of the lengths reach the pose follows from derivatives of the estimate; so does the gradient of
# that gain in the sensors' feet.

# %%
start = robot.home()[0]
twists = rng.uniform([-0.2] * 3 + [-0.35] * 3, [0.2] * 3 + [0.35] * 3, (30, 6))
workspace = pk.SE3.from_rotation_vector(start.translation + twists[:, :3], twists[:, 3:])
gains = pk.noise_gains(robot, workspace)
for name in gains._fields:
    print(
        f"{name:12} position error over length error, median {np.median(getattr(gains, name).position):.2f}"
    )
placed = pk.place_sensors(robot, workspace, radius=1.0, starts=8)
print(f"RMS gain of position and rotation: {placed.gain_before:.3f}, placed by gradients {placed.gain:.3f}")
assert placed.gain < placed.gain_before and placed.status == pk.Status.OK

# %% [markdown]
# ## The loop
#
# Fig. 4 of the patent: nine lengths, forward kinematics, PID, six actuators. The plant is sampled at 1 kHz, a
# sample late, its actuators lag by 10 ms; readings are noisy and quantized, and every leg's encoder has a
# constant error of 100 µm (one draw a machine). The platform follows a circle of radius 0.1 m while it tilts.
# All feedbacks drive the same ten machines.

# %%
circle = pk.circle_reference(robot, radius=0.1)
biased = pk.Plant(encoder_bias=1e-4)
runs = {
    feedback: pk.simulate_control(robot, circle, feedback, key=jax.random.key(0), plant=biased, seeds=10)
    for feedback in ("joint", "nine", "learned")
}
for feedback, run in runs.items():
    assert np.all(run.status == pk.Status.OK)
    print(f"{feedback:8} RMS position error {1e6 * np.sqrt(np.mean(run.rms_position**2)):6.1f} um")

# %% [markdown]
# Forward kinematics of six legs knows no more than the joints do. Nine lengths help because the three sensors
# contradict the biased legs; no unbiased estimate of a single sample does better than the one with these
# weights. Over time the contradictions tell the biases themselves: "learned" runs a Kalman filter for them
# beside the estimate.

# %%
draw_tracking(runs, scale=1e-6, unit="µm").figure

# %% [markdown]
# ## The geometry from a log
#
# All of this needs the geometry. A controller's log of a real hexapod (2,000 rows of pose and leg lengths,
# every sixth of the published ones; its licence lies beside it) gives all 36 coordinates, without any nominal
# geometry.

# %%
here = Path(__file__).parent if "__file__" in globals() else Path()
lines = (here / ".." / "examples" / "hexapod_log.csv").read_text().splitlines()
log = np.array([line.split(",") for line in lines if line[0] in "-0123456789"], float)
radians = jnp.deg2rad(log[:, 3:6])
turn = lambda axis: (
    pk.SE3.from_rotation_vector(np.zeros((len(log), 3)), radians[:, [axis]] * np.eye(3)[axis]).rotation
)
logged = pk.SE3(1e-3 * log[:, :3], turn(0) @ turn(1) @ turn(2))
identified = pk.calibrate(pk.stewart_from_log(logged, 1e-3 * log[:, 6:12]), logged, 1e-3 * log[:, 6:12])
print(
    f"RMS of the lengths {1e3 * identified.rms:.5f} mm, "
    f"{identified.rank} of {len(identified.unknowns)} unknowns"
)
worst = max(deviation.max() for deviation in identified.deviations.values())
print(f"standard deviations of the joints up to {1e3 * worst:.4f} mm")
print("base (mm)", np.round(1e3 * np.asarray(identified.mechanism.base[0]), 3))
assert identified.rms < 0.7e-6
