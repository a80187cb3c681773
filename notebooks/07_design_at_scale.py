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
# # Designs by gradients
#
# A design is judged by indices over its workspace or over a prescribed box of poses. Both are differentiable
# in the dimensions of the mechanism, so that designs are found by ascent from many starts at once: for a
# rectangle, without singularities in a box, for the largest dexterous workspace, for several indices, and for
# dimensions that scatter.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pk_jax as pk
from pk_jax.analysis.integral import integral_gradient
from pk_jax.design.families import design_family
from pk_jax.files.design_run import on_devices, run_into
from pk_jax.files.run_file import read_run
from pk_jax.viz.design import draw_front
from pk_jax.viz.style import BLUE, TINT, VERMILION

pk.enable_x64()  # the caller decides about float64, before the first array
here = Path(__file__).parent if "__file__" in globals() else Path()
examples = here / ".." / "examples"

# %% [markdown]
# ## An index over the whole workspace
#
# Two sliders on a common base drive a point (2-RPR). Its Frobenius isotropy is |det A|, the same that weighs
# areas against strokes: over the workspace its integral is the area of the square of strokes, here 4, and
# does not change while the strokes are moved. The volume does. Every value and every derivative has its own
# error estimate.

# %%
sliders = lambda v: pk.TwoRPR(half_base=1.0, l_min=v[0], l_max=v[0] + 2)
found = integral_gradient(sliders, [2.0], "frobenius_isotropy", rule="strokes")
value = found.value
print(f"area     {value.volume:.6f} +- {value.error.volume:.1e}, slope {found.volume[0]:.5f}", end=" ")
print(f"+- {found.error.volume[0]:.0e}")
print(f"integral {value.integral:.6f} +- {value.error.integral:.1e}, slope {found.integral[0]:.5f}")
print(f"mean     {value.mean:.6f} +- {value.error.mean:.1e}, slope {found.mean[0]:.5f}")
assert value.status == pk.Status.OK
assert abs(value.integral - 4) <= value.error.integral and abs(found.integral[0]) < 1e-9

# %% [markdown]
# ## A five-bar for a rectangle
#
# The worst pose of a rectangle shall be as good as possible: greatest least 1/kappa, all poses in reach and
# on one side of the singularities. A run file says so, and `pk-jax optimize` does the same. Of several
# entries the least is maximized, with multipliers for every one of them and for every limit.

# %%
run = read_run(examples / "design_five_bar.toml")
kept = tempfile.TemporaryDirectory()
whole = run_into(Path(kept.name) / "whole", run)
best = whole.design
print({name: round(float(size), 5) for name, size in best.variables.items()})
print(f"least 1/kappa {best.value:.6f}, KKT residual {best.kkt:.0e}, {best.status.name}")
ends = best.values[np.isfinite(best.values)]
print(
    f"{len(best.values)} starts, {len(ends)} feasible, {np.sum(ends > best.value - 1e-6)} at the best value"
)
assert best.status == pk.Status.OK and best.violation <= 1e-7

# %%
x, y = np.meshgrid(np.linspace(-0.5, 0.5, 41), np.linspace(0.8, 1.6, 33))
poses = np.stack([x, y], axis=-1).reshape(-1, 2)
kappa = np.asarray(pk.local_indices(best.mechanism, poses).isotropy).reshape(x.shape)
print(f"least 1/kappa on a fine grid {kappa.min():.6f}")
fig, ax = plt.subplots(figsize=(4.8, 3.4), layout="compressed")
filled = ax.contourf(x, y, kappa, levels=np.linspace(0.85, 1, 11), zorder=0)
fig.colorbar(filled, label=r"$1/\kappa$")
middle = np.array([0.0, 1.2])
pk.draw(best.mechanism, middle, pk.inverse_kinematics(best.mechanism, middle).joints, ax)
plt.show()

# %% [markdown]
# ## Interrupted, and resumed
#
# The run above has kept a folder. Another one is stopped after three chunks, and goes on from its
# checkpoint: all files of the result have the same bytes.

# %%
left, further = [3], on_devices(run, None)


def stopped(search, steps):
    if not left[0]:
        raise KeyboardInterrupt
    left[0] -= 1
    return further(search, steps)


broken = Path(kept.name) / "broken"
try:
    run_into(broken, run, further=stopped)
except KeyboardInterrupt:
    print("interrupted, left", sorted(path.name for path in broken.iterdir()))
run_into(broken, run, resume=True)
names = "result.json", "result.toml", "starts.csv", "history.csv"
same = {name: (broken / name).read_bytes() == (whole.folder / name).read_bytes() for name in names}
kept.cleanup()
print(same)
assert all(same.values())

# %% [markdown]
# ## A 3-RRR without singularities in a box
#
# `examples/design_3rrr.toml` asks for the best worst pose of a box of x, y and turns, with a clearance of
# type II singularities as a constraint; `pk-jax optimize examples/design_3rrr.toml` has found these
# dimensions. Limits hold at the nodes of the box. Between them nothing was asked for, so the distance to
# singularities of either type is looked at on a grid of 10,625 poses.

# %%
sizes = {"base_radius": 1.0, "platform_radius": 0.224941741, "proximal": 1.2, "distal": 1.15878812}
planar = design_family("3-rrr").mechanism(sizes)
grid = [np.linspace(-0.2, 0.2, 25), np.linspace(-0.2, 0.2, 25), np.linspace(-0.4, 0.4, 17)]
poses = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
rows = poses.reshape(-1, 3)
distance = pk.singularity_distance(planar, rows, pk.inverse_kinematics(planar, rows).joints, length=0.3)
least = np.asarray(distance).reshape(poses.shape[:3]).min(axis=2)
print(f"least distance to a singularity on {len(rows)} poses: {least.min():.4f}")
assert least.min() > 0.2

# %%
fig, (left_ax, right_ax) = plt.subplots(1, 2, figsize=(7.6, 3.4), layout="compressed")
pk.draw(planar, *planar.home(), left_ax)
left_ax.fill_between([-0.2, 0.2], -0.2, 0.2, color=TINT, zorder=0)
filled = right_ax.contourf(*poses[:, :, 0, :2].transpose(2, 0, 1), least, levels=10)
fig.colorbar(filled, label="least distance over all turns")
right_ax.set(xlabel="$x$", ylabel="$y$", aspect="equal")
plt.show()

# %% [markdown]
# ## The largest dexterous workspace of a hexapod
#
# `examples/design_stewart.toml` maximizes the integral of the isotropy over all poses within strokes, cones
# and
# turns of 0.15 rad, in six freedoms by 48 rays. It takes minutes and is not repeated here; `pk-jax optimize
# examples/design_stewart.toml` has found the design on the right. Two of its four dimensions lie at bounds.

# %%
family = design_family("stewart")
fixed = family.defaults | {"half_stroke": 0.2, "base_cone": 0.4, "platform_cone": 0.4}
sizes = {"platform_radius": 0.319478824, "base_half_angle": 0.144533988}
sizes |= {"platform_half_angle": 0.1, "height": 1.6}
fig = plt.figure(figsize=(7.2, 3.6), layout="compressed")
for column, (name, changed) in enumerate({"default of the family": {}, "optimized": sizes}.items(), 1):
    hexapod = family.mechanism(fixed | changed)
    ax = pk.draw(hexapod, *hexapod.home(), fig.add_subplot(1, 2, column, projection="3d"))
    ax.set_title(name)
plt.show()

# %% [markdown]
# ## Several indices: a Pareto front
#
# Five-bars over their workspace by the three indices of Nam, Lee and Park (2006): GII, GRI and SUI. The
# weighted sum is maximized for many weights in one batch.

# %%
front = pk.pareto_designs(pk.design_space("2-rrr"), 12, starts=2, steps=40)
print(f"{len(front.vectors)} designs, status {front.status.name}")
print("greatest GII, GRI, SUI", np.round(front.indices.max(axis=0), 5))
assert len(pk.pareto_front(front.indices)) == len(front.indices)

# %%
draw_front(front.indices, ("GII", "GRI", "SUI")).figure

# %% [markdown]
# ## Dimensions that scatter
#
# Links are made with errors, here of standard deviation 0.05. `pk.robust` makes of a problem another one, by
# the worst of eight samples and with all limits held by each of them. `pk.optimize_design` takes it like any
# other; here both problems are evaluated for five-bars with other distal links.

# %%
robust = pk.robust(run.problem, {"proximal": 0.05, "distal": 0.05}, samples=8, measure="worst")
share = np.linspace(0.9, 1.1, 13)
vectors = best.vector * np.stack([np.ones(13), np.ones(13), share], axis=1)
ordered = pk.evaluate_designs(run.problem, vectors, slopes=False)
made = pk.evaluate_designs(robust, vectors, slopes=False)
least = np.stack([each.objective.min(axis=1) for each in (ordered, made)])
is_inside = made.constraints.min(axis=1) >= 0
print(f"best design: {least[0, 6]:.4f} as ordered, {least[1, 6]:.4f} for the worst sample")
k = np.argmax(np.where(is_inside, least[1], -1))
print(f"distal links of {share[k]:.4f} times its length: {least[0, k]:.4f} and {least[1, k]:.4f}")
assert (
    share[6] == 1
    and np.argmax(least[0]) == 6
    and np.all(least[1] < least[0])
    and np.all(ordered.status == pk.Status.OK)
)

# %%
fig, ax = plt.subplots(figsize=(4.8, 3.2), layout="compressed")
ax.plot(share, least[0], color=BLUE, label="as ordered")
ax.plot(share, least[1], color=VERMILION, linestyle="--", label="worst of eight samples")
ax.set(xlabel="distal link over that of the best design", ylabel=r"least $1/\kappa$")
ax.legend()
plt.show()
