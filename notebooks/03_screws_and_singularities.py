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
# # Screws, statics and singularities of planar robots
#
# One closure residual gives the line on which every actuator pushes, the torques that carry a load, the kind
# of a singularity and the distance to it. This notebook sets each of them beside an independent construction:
# the lines beside ruler and compass, the loci beside their closed forms, the gradients beside differences.
# The robots are those of a screw analysis of planar parallel robots (5-link, 3-RRR, redundant 4-RRR and
# 6-link), whose figures and equations are cited as "Fig." and "eq.", and Sauer's 3-RPR. Lengths are metres.
# (The notebook takes a minute or two, most of it compilation.)

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import pk_jax as pk
from pk_jax.papers.planar_screws import geometric_screws, singular_cases
from pk_jax.viz import singularity as viz

pk.enable_x64()  # the caller decides about float64, before the first array
BLUE, VERMILION, GREEN, INK, SOFT = "#0072b2", "#d55e00", "#009e73", "#262626", "#8c8c8c"

# %% [markdown]
# ## Screws from the residual
#
# Differentiate $F(x, q) = 0$: $A\dot x + B\dot q = 0$. Joint torques $\tau$ and the wrench $W$ they exert do
# the same work, $W\cdot\dot x = \tau\cdot\dot q$, and so
#
# $$\dot q = J_F^T\,\dot x,\qquad W = J_F\,\tau,\qquad J_F^T = -B^{-1}A.$$
#
# Row $i$ of $J_F^T$ is a unit line over an arm: actuator $i$ pushes along `lines[i]`, with the torque
# `arms[i]` per newton. `pk.screws` reads both from the residual. `geometric_screws` never looks at one: it
# draws a line through two joints and measures how far the driven joint lies from it (eqs. 21-24, 29-31).

# %%
five, three, four = (pk.catalogued(name) for name in ("5-link", "3-rrr", "4-rrr"))
configurations = {
    "5-link": (five, jnp.array([0.06, 0.3])),
    "3-RRR": (three, jnp.array([0.04, -0.03, 0.25])),
}
figure = Figure(figsize=(9.5, 4.2), layout="compressed")
for ax, (name, (robot, pose)) in zip(figure.subplots(1, 2), configurations.items(), strict=True):
    joints = robot.inverse(pose)
    found, ruler = pk.screws(robot, pose, joints), geometric_screws(robot, pose, joints)
    J = pk.velocity_jacobian(robot, pose, joints)
    errors = {
        "lines": found.lines - ruler.lines,
        "arms": found.arms - ruler.arms,
        "J - J_F^-T": J - np.linalg.inv(ruler.lines / ruler.arms[:, None]),
    }
    print(f"{name:<7}", ", ".join(f"{what} {np.abs(error).max():.0e}" for what, error in errors.items()))
    assert all(np.abs(error).max() < 1e-12 for error in errors.values())

    viz.draw_screws(robot, pose, joints, ax)
    u = np.asarray(ruler.lines[:, :2])
    to_line = np.sum(np.asarray(ruler.points[:, 0] - ruler.driven) * u[:, ::-1] * [-1, 1], axis=1)
    feet = np.asarray(ruler.driven) + to_line[:, None] * u[:, ::-1] * [-1, 1]
    for driven, foot in zip(np.asarray(ruler.driven), feet, strict=True):
        ax.plot(*np.stack([driven, foot]).T, color=VERMILION, lw=1.6)
    ax.set_title(f"{name}: lines of action and, in vermilion, their arms", fontsize="medium")
figure

# %% [markdown]
# ## Four motors for three freedoms
#
# The 4-RRR has one motor more than freedoms: a wrench leaves one preload free, torques that balance one
# another. `joint_forces` takes the torques of least norm, $\tau = J_F^+ W$, `preloads` spans the rest, and
# `bounded_joint_forces` gives the least norm that keeps within the motors' limits. Carry a load of 20 N and
# 1 N m along a straight path:

# %%
x = np.linspace(-0.2, 0.2, 81)
path = jnp.asarray(np.stack([x, 0.06 + 0 * x, 0.15 + 0 * x], axis=1))
joints = pk.inverse_kinematics(four, path).joints
wrench = jnp.array([0.0, -20.0, 1.0])  # N, N, N m about the platform's origin

least = pk.joint_forces(four, path, joints, wrench)
inner = pk.preloads(four, path, joints)[:, 0]
widest = np.abs(least).max()
limit = 0.9 * widest
bounded = pk.bounded_joint_forces(four, path, joints, wrench, -limit, limit)
assert np.all(np.asarray(bounded.status) == pk.Status.OK)
for torques in (least, bounded.forces):
    assert np.abs(pk.platform_wrench(four, path, joints, torques) - wrench).max() < 1e-10
assert np.abs(pk.platform_wrench(four, path, joints, inner)).max() < 1e-12  # a preload moves nothing
assert np.abs(jnp.sum(least * inner, axis=1)).max() < 1e-12  # and the least norm has none of it

z = np.linspace(-4, 4, 401)
every = np.asarray(least)[:, None] + z[:, None] * np.asarray(inner)[:, None]  # (path, z, motors)
needed = np.abs(every).max(axis=2)
print(f"greatest torque of least norm {widest:.2f} N m; with the best preload {needed.min(axis=1).max():.2f}")
print(f"within {limit:.2f} N m everywhere; the norm grows by up to", end=" ")
print(f"{np.max(np.linalg.norm(bounded.forces, axis=1) / np.linalg.norm(least, axis=1)) - 1:.1%}")

figure = Figure(figsize=(9.5, 3.6), layout="constrained")
left, right = figure.subplots(1, 2)
for motor, color in enumerate((BLUE, VERMILION, GREEN, INK)):
    left.plot(x, least[:, motor], ":", color=color)
    left.plot(x, bounded.forces[:, motor], color=color, label=f"motor {motor + 1}")
for side in (-limit, limit):
    left.axhline(side, color=SOFT, lw=0.8)
left.set(xlabel="$x$ (m)", ylabel="torque (N m)", title="least norm (dotted), within limits (solid)")
left.legend(frameon=False, fontsize="small", ncols=2)
for row, color in zip((0, 40, 80), (BLUE, INK, VERMILION), strict=True):
    right.plot(z, needed[row], color=color, label=f"$x$ = {x[row]:.1f} m")
right.axhline(limit, color=SOFT, lw=0.8)
right.set(xlabel="preload $z$ (N m)", ylabel="greatest torque (N m)", title="what a preload costs, and saves")
right.legend(frameon=False, fontsize="small")
figure

# %% [markdown]
# The same lines and arms give the stiffness, $K = J_F\,\mathrm{diag}(k)\,J_F^T$. The ellipses are the
# displacements of the platform's origin under a force of 20 N from all sides, threefold, with motors of
# 200 N m/rad: nearly round in the middle, long and thin towards the corners.

# %%
grid = np.stack(np.meshgrid(np.linspace(-0.15, 0.15, 6), np.linspace(-0.15, 0.15, 6)), axis=-1).reshape(-1, 2)
poses = jnp.asarray(np.column_stack([grid, 0.15 + 0 * grid[:, 0]]))
solved = pk.inverse_kinematics(four, poses)
assert np.all(np.asarray(solved.status) == pk.Status.OK)
K = pk.stiffness(four, poses, solved.joints, 200.0)
compliance = np.linalg.inv(K)[:, :2, :2]
assert np.linalg.eigvalsh(K).min() > 0
turn = np.linspace(0, 2 * np.pi, 49)
outlines = np.einsum("kij,jt->kti", 20 * compliance, np.stack([np.cos(turn), np.sin(turn)]))
softest = 1e3 * 20 * np.linalg.eigvalsh(compliance)[:, -1]
print(f"greatest displacement under 20 N: {softest.min():.2f} to {softest.max():.2f} mm")

ax = pk.draw(four, path[40], joints[40], color="#c8c8c8")
for centre, outline in zip(grid, outlines, strict=True):
    ax.plot(*(centre + 3 * outline).T, color=BLUE, lw=1.2)
ax.figure

# %% [markdown]
# ## Singular configurations
#
# A type I (inverse) singularity lets joints move while the platform stands; a type II (direct) one lets the
# platform move while the motors are locked; at a configuration-space singularity the closure equations
# themselves are dependent. `singular_cases` builds the poses of Figs. 2-13 by putting the lines where the
# figures show them. Eight of them, their lines dashed, with the pole (cross) or the direction (arrow) of the
# free motion where it is in sight:

# %%
every_case = singular_cases()
cases = [every_case[i] for i in (0, 2, 7, 9, 10, 13, 16, 17)]
figure = viz.singular_configurations(cases)
figure.set_layout_engine("constrained")
for ax in figure.axes:
    ax.title.set_fontsize(8)
figure

# %% [markdown]
# The three distances are sines of angles between motions that exist and those that a singularity would have.
# The last column is the usual test: the rank of the lines, beside the rank that a held platform needs.

# %%
print("figure  robot and pose                    kind                  sigma I  sigma II  rank of lines")
for case in cases:
    found = pk.classify_singularity(case.mechanism, case.pose, case.joints)
    lines = np.array(pk.screws(case.mechanism, case.pose, case.joints).lines)
    rank = np.linalg.matrix_rank(lines, tol=1e-6)
    kind = pk.SingularityKind(int(found.kind))
    print(f"{case.figure or '-':<7} {case.title:<33} {kind.name:<20}", end="  ")
    print(f"{found.sigma_inverse:7.4f}  {found.sigma_direct:8.4f}  {rank} of {lines.shape[1]}")
    assert kind == case.kind

# %% [markdown]
# Fig. 12 is printed as a direct singularity, since its lines fall together. Locked motors hold the platform
# there, too (sigma II is 0.32); it is the closure equations that are dependent. In the last row the rank is
# plainly wrong. Both arms of the 6-link are stretched, its four lines fall on two, rank 2
# of 3: by their rank the platform should be free. It is not. The two motors of an arm, locked, hold its tip
# wherever they are; two held tips hold the coupler. The lines of an arm are the rows of
# $\mathrm{adj}(B_i)\,A_i$, and where the arm is stretched $\mathrm{adj}(B_i)$ has rank 1 though the
# constraint $A_i$ keeps rank 2. The lines have lost a force that the arm still exerts,
# one that needs no torque. So lines judge type II only where no arm of several motors is near type I;
# `sigma_direct` asks the constraints themselves:

# %%
six, stretched = cases[-1].mechanism, jnp.asarray(cases[-1].pose)
modes = jnp.sign(jnp.sin(jnp.array([1.0, 1.0])))  # any one: they meet where the arms are stretched
print("below the stretched pose   least sigma of the lines   sigma I     sigma II")
for below in (1e-2, 1e-4, 1e-6):
    pose = stretched - jnp.array([0, below, 0])
    joints = six.inverse(pose, modes)
    found, lines = pk.classify_singularity(six, pose, joints), np.array(pk.screws(six, pose, joints).lines)
    lines[:, 2] /= six.length()
    of_lines = np.linalg.svd(lines, compute_uv=False)[-1]
    print(f"{below:20.0e} m {of_lines:27.1e} {found.sigma_inverse:13.1e} {found.sigma_direct:9.4f}")
assert of_lines < 0.01 < 0.1 < found.sigma_direct

# %% [markdown]
# ## The distance is a distance
#
# Drive the 4-RRR through Fig. 9(b), where four lines meet in a point. With more equations than freedoms there
# is no $\det A$; the textbook takes $\det A^T A$, which depends on the unit of length, lies flat at its zero
# and changes no sign there. The distance $\sigma$ falls to zero linearly and has no unit.

# %%
case = cases[5]
branch = np.sign(np.sin([0.9, -1.1, 1.3, -0.8]))  # the bends that Fig. 9(b) was built with
pose_jacobians = jax.jit(jax.vmap(pk.pose_jacobian, (None, 0, 0)))
millimetres = jax.tree.map(lambda leaf: 1000 * leaf, case.mechanism)


def along(robot, steps, unit=1.0):
    """sigma_direct and det A^T A on a straight path in x through the singular pose; steps in metres."""
    poses = jnp.asarray((case.pose + np.outer(steps, [1, 0, 0])) * [unit, unit, 1])
    joints = pk.inverse_kinematics(robot, poses, branch).joints
    A = np.asarray(pose_jacobians(robot, poses, joints))
    sigma = np.asarray(pk.classify_singularity(robot, poses, joints).sigma_direct)
    return sigma, np.linalg.det(A.transpose(0, 2, 1) @ A)


steps, fine = np.linspace(-0.03, 0.03, 80), np.geomspace(1e-5, 2e-2, 80)
sigma, gram = along(case.mechanism, steps)
sigma_fine, gram_fine = along(case.mechanism, fine)
sigma_mm, gram_mm = along(millimetres, steps, 1000.0)
print(f"in millimetres: det A^T A times {np.median(gram_mm / gram):.0e},", end=" ")
print(f"sigma changed by {np.abs(sigma_mm - sigma).max():.0e}")
order = [np.polyfit(np.log(fine[:40]), np.log(values[:40]), 1)[0] for values in (sigma_fine, gram_fine)]
print(f"orders at the zero: sigma {order[0]:.3f}, det A^T A {order[1]:.3f}")
assert np.allclose(order, [1, 2], atol=0.02) and np.abs(sigma_mm - sigma).max() < 1e-10

figure = Figure(figsize=(9.5, 3.3), layout="constrained")
left, right = figure.subplots(1, 2)
left.plot(1e3 * steps, sigma / sigma[0], color=BLUE, label=r"$\sigma$")
left.plot(1e3 * steps, gram / gram[0], "--", color=VERMILION, label=r"$\det A^T A$")
left.set(xlabel="way from the singularity (mm)", ylabel="over the value at the left end")
left.legend(frameon=False)
right.loglog(1e3 * fine, sigma_fine / sigma[0], color=BLUE)
right.loglog(1e3 * fine, gram_fine / gram[0], "--", color=VERMILION)
right.set(xlabel="way from the singularity (mm)")
figure

# %% [markdown]
# A distance with a derivative can be designed with: `pk.singularity_distance` is differentiable in the
# geometry. Twelve poses of a 3-RRR must be kept away from type II: the corners of a square, each in three
# turns. Free are the share of the proximal links in the arms' length of 0.6 m and the places of the platform
# joints on their circle. The joints follow the geometry, so they are computed inside; `length` fixes the
# ruler, which by default is the platform's radius and grows with it. The least of twelve distances has
# corners; its soft version $-\frac1\beta\log\sum e^{-\beta\sigma_i}$ is smooth, and steps of shrinking length
# climb it.

# %%
task = jnp.asarray([[x, y, phi] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for phi in (-0.5, 0.0, 0.5)])


def designed(v):
    """v: proximal share of an arm, angles of the platform joints."""
    platform = 0.15 * jnp.stack([jnp.cos(v[1:]), jnp.sin(v[1:])], axis=1)
    return pk.PlanarRRR(base=three.base, platform=platform, proximal=0.6 * v[0], distal=0.6 * (1 - v[0]))


def soft_least(v):
    robot = designed(v)
    joints = jax.vmap(robot.inverse)(task)
    values = pk.singularity_distance(robot, task, joints, kind="II", length=0.15)
    return -jax.nn.logsumexp(-60 * values) / 60, values


climb = jax.jit(jax.value_and_grad(soft_least, has_aux=True))
start = jnp.append(0.5, jnp.arctan2(three.platform[:, 1], three.platform[:, 0]))
slope = climb(start)[1]
central = [(climb(start + h)[0][0] - climb(start - h)[0][0]) / 2e-5 for h in 1e-5 * jnp.eye(4)]
print("gradient at the start   ", np.round(slope, 7))
print("by central differences  ", np.round(np.array(central), 7))
assert np.allclose(slope, central, atol=1e-5)

v, history = start, []
for k in range(50):
    (_, values), g = climb(v)
    history.append((float(values.min()), v, np.asarray(values)))
    v = v + 0.08 * 0.93**k * g / jnp.linalg.norm(g)
least, best, after = max(history, key=lambda row: row[0])
before = history[0][2]
print(f"least distance to type II {before.min():.4f} -> {least:.4f}")
print(f"proximal link {0.6 * best[0]:.3f} m of 0.6 m; platform joints turned by", end=" ")
print(np.round(np.degrees(best[1:] - start[1:]), 1), "deg")
assert np.all(after > before) and least > 1.3 * before.min()

figure = Figure(figsize=(9.5, 3.6), layout="compressed")
left, middle, right = figure.subplots(1, 3)
for vector, color in ((start, "#b0b0b0"), (best, BLUE)):
    robot = designed(vector)
    pk.draw(robot, jnp.zeros(3), robot.inverse(jnp.zeros(3)), left, color=color)
left.set_title("before (grey), after (blue)", fontsize="medium")
middle.plot([row[0] for row in history], color=BLUE)
middle.set(xlabel="step", title="least distance to type II")
right.bar(np.arange(12) - 0.2, before, 0.4, color="#b0b0b0")
right.bar(np.arange(12) + 0.2, after, 0.4, color=BLUE)
right.set(xlabel="pose of the task", xticks=range(0, 12, 2), title="distance to type II")
figure

# %% [markdown]
# Every one of the twelve gains, the worst most; another task has another optimum.
#
# ## Loci
#
# `pk.singularity_locus` finds the curves of both types over two coordinates, in every working mode. Least
# values of $\sigma$ on a grid are polished on $F = 0$, $Av = 0$, $|v| = 1$ (or $Bv = 0$), then followed.
# Here is the 5-link, where both have a closed form: type I on circles of radius $l_a + l_b$ and
# $|l_a - l_b|$ about the base joints, type II where the distal links are parallel.

# %%
locus = pk.singularity_locus(five, nodes=41)
base, la, lb = np.asarray(five.base()), float(five.proximal), float(five.distal)


def points_of(kind):
    """Coordinates and joints of all points of one type."""
    curves = locus.of(kind)
    return (np.concatenate([getattr(curve, name) for curve in curves]) for name in ("coordinates", "joints"))


P, _ = points_of(pk.SingularityKind.TYPE_I)
away = np.linalg.norm(P[:, None] - base, axis=2)[..., None] - [la + lb, abs(la - lb)]
off_circle = np.abs(away).min(axis=(1, 2)).max()
P, q = points_of(pk.SingularityKind.TYPE_II)
u = (P[:, None] - base - la * np.stack([np.cos(q), np.sin(q)], axis=2)) / lb  # along the distal links
sine = np.abs(u[:, 0, 0] * u[:, 1, 1] - u[:, 0, 1] * u[:, 1, 0]).max()
print(f"type I: {len(away)} points, off their circle {off_circle:.0e} m;", end=" ")
print(f"type II: {len(P)} points, sine between the distal links {sine:.0e}")
assert off_circle < 1e-10 and sine < 1e-9
viz.draw_locus(five, locus, unit="m")

# %% [markdown]
# ### Assembly modes on both sides
#
# Sauer's 3-RPR with legs of 5, 7 and 3 has six assembly modes. Each has its own $\varphi$, hence its own
# slice of the locus. At a fixed $\varphi$, $\det A$ is quadratic in $x$ and $y$, and the slice a conic. The
# sign of $\det A$ says on which side of it a mode lies, and as real solutions of this system come and go in
# pairs of opposite sign, three lie on each. Three of them are drawn.

# %%
sauer, legs = pk.catalogued("sauer-3-rpr"), jnp.array([5.0, 7.0, 3.0])


@jax.jit
def assembly_modes(robot, legs):
    """Poses, whether they are real, what they leave of the residual, det A."""
    poses, is_real = robot.forward(legs)
    A = jax.vmap(lambda pose: pk.pose_jacobian(robot, pose, legs))(poses)
    return poses, is_real, jax.vmap(lambda pose: robot.residual(pose, legs))(poses), jnp.linalg.det(A)


modes, is_real, left_over, det = assembly_modes(sauer, legs)
assert is_real.all() and np.abs(left_over).max() < 1e-10
signs = np.sign(det).astype(int).tolist()
assert sum(signs) == 0

x, y = np.meshgrid(np.linspace(-8, 8, 81), np.linspace(-6, 10, 81))
monomials = np.stack([(x.ravel() / 8) ** i * (y.ravel() / 8) ** j for i in range(3) for j in range(3 - i)], 1)


@jax.jit
def det_in_slice(robot, phi):
    """det A at the nodes of the slice; the legs are those that reach them."""
    poses = jnp.column_stack([x.ravel(), y.ravel(), jnp.full(x.size, phi)])
    A = jax.vmap(lambda pose: pk.pose_jacobian(robot, pose, robot.inverse(pose)))(poses)
    return jnp.linalg.det(A)


figure = Figure(figsize=(9.5, 3.6), layout="compressed")
worst = 0.0
shown = slice(0, 3)
for ax, mode, sign in zip(figure.subplots(1, 3, sharey=True), modes[shown], signs[shown], strict=True):
    values = np.asarray(det_in_slice(sauer, mode[2]))
    conic = np.linalg.lstsq(monomials, values)[0]
    worst = max(worst, np.abs(monomials @ conic - values).max() / np.abs(values).max())
    ax.contour(x, y, values.reshape(x.shape), [0], colors=VERMILION, linewidths=1.4)
    pk.draw(sauer, mode, legs, ax, color=BLUE if sign > 0 else INK)
    ax.plot(*mode[:2], "o", color=VERMILION, ms=5, zorder=9)
    side = "+" if sign > 0 else "\N{MINUS SIGN}"
    ax.set_title(rf"$\varphi$ = {np.degrees(mode[2]):.1f} deg, side {side}", fontsize="medium")
    ax.set(xlim=(-8, 8), ylim=(-6, 10))
print(f"signs {signs}; det A less its conic, over the greatest, {worst:.0e}")
assert worst < 1e-12
figure

# %% [markdown]
# The vermilion dot is the platform's origin, the point that the locus is drawn for. Every path from a blue
# mode to a black one crosses type II.
#
# ### Codimension 2
#
# The 4-RRR has four equations for three freedoms: type II takes two conditions, and its locus is made of
# curves in $(x, y, \varphi)$, not of surfaces. One working mode:

# %%
curves = pk.singularity_locus(four, "x,y,phi", branch=[1, 1, 1, 1], nodes=17)
every = [np.concatenate([getattr(c, name) for c in curves.curves]) for name in ("pose", "joints")]
rows = np.asarray(pose_jacobians(four, *every)) / [1, 1, float(four.length())]
spread = np.linalg.svd(rows, compute_uv=False)
worst = np.max(spread[:, -1] / spread[:, 0])
print(f"{len(rows)} points; least over greatest singular value of A there: {worst:.0e}")
assert worst < 1e-9
on_grid = curves.sigma_direct[np.isfinite(curves.sigma_direct)]
print(f"least sigma on the {on_grid.size} nodes in reach: {on_grid.min():.4f};", end=" ")
print(f"nodes below 0.01: {np.sum(on_grid < 0.01)}")
viz.draw_locus(four, curves, unit="m")

# %% [markdown]
# (Colours tell pieces apart; a piece may go on in the next.) A contour of a determinant would have missed all
# of it. $\det A^T A$ is nowhere negative: it has no zero
# contour, only valleys, and a grid steps over them. A contour of one $3\times3$ minor has the curves in
# it, but is a surface, regular nearly everywhere: the fourth arm holds the platform.
#
# ## What to trust
#
# - **Points of a locus** satisfy their equations to 1e-10. That **no curve is missing** is not proved:
#   features smaller than a cell of the grid may be. Double `nodes` and compare.
# - **Kinds** are to a tolerance, 1e-6 by default. Near a stretched arm the joints are known only to the root
#   of roundoff, so that a finer tolerance means nothing there; a coarser one selects a band.
# - **Distances** are first-order: sines between motions, at one configuration. They say nothing of what the
#   mechanism does at a singularity beyond the first order, and the distance in metres to the locus is another
#   number. They depend on `length`, the ruler between metres and radians: name it when you compare designs.
# - **Gradients** of a least value are those of one side where two are equal; hence the soft minimum above.
# - **Lines** tell type II only away from type I, where a leg has several motors.
# - **Statics** are rigid and without friction or weight of the links.
#
# The same from the shell, for a catalogue name or a file of your own:
#
#     pk-jax singularity 3-rrr -o map.png
