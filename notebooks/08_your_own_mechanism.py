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
# # A mechanism of your own
#
# A mechanism is a class with its geometry and five methods for one configuration. Here a Delta robot (Clavel
# 1988) is written from nothing, and everything else follows: screws, singularities, workspace, a design by
# gradients, all assembly modes. Then a 3-RPS, whose platform moves aside when it tilts.

# %%
# %matplotlib inline
import itertools
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import pk_jax as pk
from pk_jax.viz.assembly import draw_modes
from pk_jax.viz.style import BLUE, GREEN, INK, VERMILION
from pk_jax.viz.workspace_map import draw_map, label_axes

pk.enable_x64()  # the caller decides about float64, before the first array

# %% [markdown]
# ## The Delta
#
# Three arms turn about edges of the base, rods in parallel pairs keep the platform from turning. Each closure
# equation says how far apart the two ends of a rod are, and holds one joint: such a class is a
# `pk.ExplicitMechanism`, whose inverse kinematics follows in closed form. It is also `examples/delta.py`, so
# that `pk-jax show examples/delta.py:robot` works, too.


# %%
class Delta(pk.ExplicitMechanism):
    """Three arms, three rods, a platform that only translates. Pose (x, y, z), joints the arms' angles."""

    base_radius: jax.Array
    platform_radius: jax.Array
    arm: jax.Array
    rod: jax.Array
    joint_units = (0, 0, 0)

    def rings(self, pose, joints):  # shoulders, elbows and ends of the rods, a column each
        out, up = jnp.array([[2, -1, -1], [0, 3**0.5, -(3**0.5)], [0, 0, 0]]) / 2, jnp.eye(3)[:, 2:]
        elbows = (self.base_radius + self.arm * jnp.cos(joints)) * out - self.arm * jnp.sin(joints) * up
        return self.base_radius * out, elbows, pose[:, None] + self.platform_radius * out

    def residual(self, pose, joints):
        _, elbows, ends = self.rings(pose, joints)
        return jnp.sum((ends - elbows) ** 2, axis=0) - self.rod**2

    def home(self):
        across = self.base_radius + self.arm - self.platform_radius
        return jax.lax.stop_gradient(jnp.array([0, 0, -1]) * jnp.sqrt(self.rod**2 - across**2)), jnp.zeros(3)

    def length(self):
        return self.rod

    def margins(self, pose, joints):
        return {"arms": 1 - jnp.abs(joints) / (jnp.pi / 2), "reach": self.reach(pose)}

    def skeleton(self, pose, joints):
        bars = (*((i, i + 3) for i in range(6)), (6, 7), (7, 8), (8, 6))
        return pk.Skeleton(jnp.concatenate(self.rings(pose, joints), axis=1).T, bars, ground=(0, 1, 2))


delta = Delta(base_radius=0.2, platform_radius=0.05, arm=0.35, rod=0.8)

# %% [markdown]
# `check_mechanism` tries the laws that every mechanism obeys, and names the first one broken.

# %%
print(pk.check_mechanism(delta))

# %% [markdown]
# ## Screws and forces
#
# The wrench of each motor is a force along its rods: what the residual says is what a drawing shows. Virtual
# work is a check, and so are the directions of the rods.

# %%
pose = np.array([0.15, 0.1, -0.7])
joints = pk.inverse_kinematics(delta, pose).joints
screws = pk.screws(delta, pose, joints)
points = np.asarray(delta.skeleton(pose, joints).points)
rods = (points[6:] - points[3:6]) / 0.8
print("angles  ", np.round(np.degrees(joints), 3), "deg")
print("lines   ", np.round(np.asarray(screws.lines), 4).tolist())
print("arms    ", np.round(np.asarray(screws.arms), 4), "m")
weight = np.array([0, 0, -20.0])
torques = pk.joint_forces(delta, pose, joints, -weight)
print("torques ", np.round(np.asarray(torques), 3), "N m, to hold 20 N")
stiff = np.linalg.eigvalsh(pk.stiffness(delta, pose, joints, 2e3))
print("stiffness along its axes", np.round(stiff / 1e3, 2), "N/mm with motors of 2 kN m/rad")
assert np.abs(np.abs(np.sum(rods * screws.lines, axis=1)) - 1).max() < 1e-12
assert np.abs(pk.velocity_jacobian(delta, pose, joints).T @ -weight - torques).max() < 1e-9

# %%
ax = pk.draw(delta, pose, joints)
for end, line in zip(points[6:], np.asarray(screws.lines), strict=True):
    ends = end + np.array([[-1.0], [0.25]]) * line * np.sign(line[2]) * -1
    ax.plot(*ends.T, color=BLUE, linewidth=1.1, linestyle=(0, (5, 3)))
ax.view_init(18, -70)
ax.figure

# %% [markdown]
# ## Workspace, singularities, isotropy
#
# At one height: where all arms stay within a right angle of the horizontal, the poses with the rods parallel
# to one plane (type II singularities of the working mode, in orange), and 1/kappa of the Jacobian.

# %%
height = np.array([0.0, 0.0, -0.55])
box = ((-0.9, 0.9), (-0.9, 0.9))
inside = pk.workspace_map(delta, ("x", "y"), at=height, ranges=box, nodes=161)
mode = pk.working_modes(delta)[0]
locus = pk.singularity_locus(delta, ("x", "y"), at=height, ranges=box, branch=mode, kinds=("II",), nodes=31)
x, y = np.meshgrid(np.linspace(-0.7, 0.7, 41), np.linspace(-0.7, 0.7, 41))
poses = np.stack([x, y, np.full_like(x, height[2])], axis=-1).reshape(-1, 3)
isotropy = np.asarray(pk.local_indices(delta, poses).isotropy).reshape(x.shape)

fig, axes = plt.subplots(1, 2, figsize=(8.4, 3.7), layout="compressed")
draw_map(inside, axes[0], unit="m")
filled = axes[1].contourf(x, y, isotropy, levels=np.linspace(0, 0.6, 13))
edge = axes[1].contour(*inside.nodes, np.nan_to_num(inside.margin, nan=-1).T, levels=[0], colors=INK)
filled.set_clip_path(edge.get_paths()[0], axes[1].transData)
fig.colorbar(filled, ax=axes[1], label=r"$1/\kappa$", shrink=0.85)
label_axes(inside, axes[1], "m")
for curve in locus.curves:
    axes[0].plot(*curve.coordinates.T, color=VERMILION, linewidth=1.6)
for ax in axes:
    ax.set(xlim=box[0], ylim=box[1], aspect="equal")
print(len(locus.curves), "curves of type II, farthest off", f"{max(c.sigma.max() for c in locus.curves):.0e}")
plt.show()

# %% [markdown]
# The volume of the workspace, on a grid of 226,981 poses, and how far each coordinate goes from the middle:

# %%
cube = ((-0.9, 0.9), (-0.9, 0.9), (-1.3, 0.1))
whole = pk.workspace_map(delta, ("x", "y", "z"), ranges=cube, nodes=61)
print(f"volume {whole.is_inside.mean() * np.prod(np.diff(cube)):.3f} m^3")
for name in "xyz":
    ends = pk.travel(delta, name, at=np.array([0, 0, -0.65]))
    print(f"{name}: {ends.lower:.4f} ({ends.limit_lower}) .. {ends.upper:.4f} ({ends.limit_upper})")

# %% [markdown]
# ## A design by gradients
#
# A cylinder of poses, half a metre wide and 0.2 m high, shall be as isotropic as possible at its worst pose,
# all arms staying within their limits. Variables are the base, the arms and the rods; the derivatives come
# through the residual alone.

# %%
turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
rim = 0.25 * np.column_stack([np.cos(turns), np.sin(turns)])
cylinder = np.array([[*xy, z] for xy, z in itertools.product([*rim, (0.0, 0.0)], (-0.1, 0.1))])
sizes = {"base_radius": (0.1, 0.4), "arm": (0.2, 0.5), "rod": (0.4, 1.0)}
middle = np.array([0.0, 0.0, -0.65])
problem = pk.DesignProblem(
    lambda v: Delta(platform_radius=0.05, **v),
    sizes,
    objective=pk.least_over(cylinder + middle, "isotropy"),
    constraints=pk.margins_over(cylinder + middle),
    name="Delta",
)
start = np.array([0.2, 0.35, 0.8])
values = pk.evaluate_designs(problem, start[None])
best = pk.optimize_design(problem, starts=6, steps=60)
least = values.objective.min()
print(f"least 1/kappa: {least:.4f} of the first design, {best.value:.4f} of the best, {best.status.name}")
print({name: round(float(size), 4) for name, size in best.variables.items()})
step = 1e-6 * np.eye(3)
ends = [pk.evaluate_designs(problem, start + way * step, slopes=False).objective for way in (1, -1)]
off = np.abs((ends[0] - ends[1]).T / 2e-6 - values.objective_slopes[0]).max()
print(f"derivatives against differences: {off:.0e}")
assert best.status == pk.Status.OK and off < 1e-6

# %%
fig = plt.figure(figsize=(7.6, 3.8), layout="compressed")
for column, robot in enumerate((delta, best.mechanism), 1):
    ax = fig.add_subplot(1, 2, column, projection="3d")
    pk.draw(robot, middle, pk.inverse_kinematics(robot, middle).joints, ax)
    for z in (-0.1, 0.1):
        ax.plot(*(np.vstack([rim, rim[:1]]).T), middle[2] + z, color=VERMILION)
    ax.view_init(14, -65)
    ax.set_title("first design" if column == 1 else "best design")
plt.show()

# %% [markdown]
# ## All assembly modes
#
# With the arms held, the platform hangs on three spheres: two poses. They are found from many starts, so that
# the search cannot call itself complete; the intersection of the spheres says that it is.

# %%
modes = pk.assembly_modes(delta, joints)
print(f"{modes.count} poses by {modes.method}, all certified: {bool(np.all(modes.is_certified[:2]))}")
print(np.round(np.asarray(modes.poses[:2]), 6))
assert modes.count == 2 and np.abs(np.asarray(modes.poses[0]) - pose).max() < 1e-12

# %%
draw_modes(delta, joints, modes)

# %% [markdown]
# ## A 3-RPS
#
# `examples/three_rps.py`: three telescopic legs on hinges, with ball joints at the platform, which has a
# height and two tilts. Three planes draw the centre aside where it tilts, which is part of the residual.

# %%
scope = {}
here = Path(__file__).parent if "__file__" in globals() else Path()
exec((here / ".." / "examples" / "three_rps.py").read_text(), scope)
lift = scope["robot"]
print(lift)
tilted = np.array([0.64, 0.3, 0.1])
legs = pk.inverse_kinematics(lift, tilted).joints
print("legs", np.round(np.asarray(legs), 5), "m")
print("forces to hold 100 N:", np.round(np.asarray(pk.joint_forces(lift, tilted, legs, [100, 0, 0])), 2), "N")
tips = np.asarray(lift.skeleton(tilted, legs).points)[3:]
across = np.array([[0, 1, 0], [-(0.75**0.5), -0.5, 0], [0.75**0.5, -0.5, 0]])
print(f"farthest tip from the plane of its hinge: {np.abs(np.sum(across * tips, axis=1)).max():.0e} m")

# %%
around = np.linspace(0, 2 * np.pi, 121)
fig = plt.figure(figsize=(8.0, 3.6), layout="compressed")
left = fig.add_subplot(1, 2, 1, projection="3d")
pk.draw(lift, tilted, legs, left)
left.view_init(16, -60)
right = fig.add_subplot(1, 2, 2)
for tilt, color in ((10, BLUE), (20, GREEN), (30, VERMILION)):
    size = 2 * np.tan(np.radians(tilt) / 2)
    poses = [[0.64, size * np.cos(t), size * np.sin(t)] for t in around]
    centres = 1e3 * np.mean([np.asarray(lift.tips(jnp.asarray(p))) for p in poses], axis=1)
    right.plot(centres[:, 0], centres[:, 1], color=color, label=f"tilt {tilt}°")
right.set(xlabel="$x$ of the centre (mm)", ylabel="$y$ (mm)", aspect="equal", ylim=(-16, 21))
right.legend(loc="upper center", ncols=3, fontsize=8)
plt.show()

# %% [markdown]
# The same legs fit other poses of this operation mode, some of them mirror images below the base.

# %%
several = pk.assembly_modes(lift, legs)
signs = several.det_sign[several.is_real].astype(int).tolist()
print(f"{several.count} poses, signs of det A {dict(Counter(signs))}")
draw_modes(lift, legs, several)
