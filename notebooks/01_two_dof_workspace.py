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
# # Two-degree-of-freedom parallel mechanisms: from one residual to an optimal design
#
# We follow Nam, Lee and Park, *Comparison study of 2-DOF parallel mechanisms: workspace optimization and
# kinematic performance*, Trans. KSME A 30(11), 2006. Equation numbers are theirs. Two mechanisms move a
# point $C = (x, y)$ in the plane: the **2-RPR** with two driven leg lengths, and the **2-RRR** (the
# five-bar) with two driven angles. All lengths are in units of $R$, half the distance between the base
# joints.
#
# The questions, in order: where is the point, how well does the mechanism move there, how well does it move
# on average, and which link lengths make that average best?

# %%
# %matplotlib inline
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import pk_jax as pk
from pk_jax.viz import two_dof

pk.enable_x64()  # the caller decides about float64, before the first array

# %% [markdown]
# ## A mechanism is its geometry and one residual
#
# A leg of the five-bar says one thing: the distal link has length $l_b$ (eq. 3). With the elbow
# $d_i = B_i + l_a(\cos\phi_i, \sin\phi_i)$,
#
# $$F_i(x, q) = \tfrac12\left(|C - d_i|^2 - l_b^2\right) = 0, \qquad i = 1, 2.$$
#
# The Jacobians, the singularities and the forward kinematics below all follow from it. The design is the
# one that the paper chooses. (The notebook takes about a minute, most of it compilation.)

# %%
robot = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15)
pose = jnp.array([-0.4, 1.9])
joints = robot.inverse(pose)  # an optional closed form, eqs. (5)-(6)

print(robot)
print("driven angles (deg)", np.degrees(joints).round(3))
print("residual F         ", robot.residual(pose, joints))

ax = two_dof.workspace_outline(robot, None, filled=True)
pk.draw(robot, pose, joints, ax).figure

# %% [markdown]
# ## Inverse and forward kinematics, with a status for every row
#
# A batch never raises: each row carries a `Status`, and a row that is not `OK` has NaN for an answer. Three
# poses: an ordinary one, one out of reach, and one where leg 1 is stretched, a type I singularity: the
# angles exist (they stay in `.candidate`), but their rates do not.

# %%
stretch = robot.proximal + robot.distal
stretched = robot.base()[0] + stretch * jnp.array([jnp.cos(2.1), jnp.sin(2.1)])
solved = pk.inverse_kinematics(robot, jnp.stack([pose, jnp.array([0.0, 5.0]), stretched]))
for status, angles, candidate in zip(solved.status, solved.joints, solved.candidate, strict=True):
    print(f"{pk.Status(status).name:<12} joints {angles}  candidate {candidate}")

# %% [markdown]
# Forward kinematics is Newton's method from the home pose. We send every pose of a grid through both and
# ask for the way back. `margins` says which poses lie in the workspace: reach of both legs, and $y > 0$.

# %%
x, y = np.meshgrid(np.linspace(-2, 2, 33), np.linspace(0.1, 3, 24))
grid = jnp.stack([x.ravel(), y.ravel()], axis=1)
margins = jax.vmap(lambda p: jnp.hstack([*robot.margins(p, joints).values()]))(grid)
poses = grid[margins.min(axis=1) > 0.02]

found = pk.forward_kinematics(robot, pk.inverse_kinematics(robot, poses).joints)
is_ok = found.status == pk.Status.OK
round_trip = jnp.max(jnp.abs(found.pose - poses)[is_ok])
print(f"{int(is_ok.sum())} of {len(poses)} poses OK; greatest |FK(IK(x)) - x| = {round_trip:.1e}")
assert is_ok.all() and round_trip < 1e-12

# %% [markdown]
# ## Jacobians without typing them
#
# $A = \partial F/\partial x$ and $B = \partial F/\partial q$ come from the residual by automatic
# differentiation, and $J = -A^{-1}B$ maps joint rates to the velocity of $C$ (eq. 8, where $J_x = A$ and
# $J_q = -B$). Here they stand against the paper's formulas: eqs. (10), (11) for the 2-RPR, eqs. (14), (15)
# for the 2-RRR. The last line is a law: $J$ times the derivative of the inverse kinematics is the identity.


# %%
@jax.jit
def jacobians(mech, pose, joints):
    """A, B and J of any mechanism."""
    of = mech, pose, joints
    return pk.pose_jacobian(*of), pk.joint_jacobian(*of), pk.velocity_jacobian(*of)


telescope = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
lengths = telescope.inverse(pose)
A_rpr, B_rpr, _ = jacobians(telescope, pose, lengths)
A_rrr, B_rrr, J_rrr = jacobians(robot, pose, joints)

X, Y = (pose - robot.elbows(joints)).T
moments = -robot.proximal * (X * jnp.sin(joints) - Y * jnp.cos(joints))
printed = {
    "eq. 10, Jq of 2-RPR": (-B_rpr, jnp.diag(lengths)),
    "eq. 11, Jx of 2-RPR": (A_rpr, pose - telescope.base()),
    "eq. 14, Jq of 2-RRR": (-B_rrr, jnp.diag(moments)),
    "eq. 15, Jx of 2-RRR": (A_rrr, jnp.stack([X, Y], axis=1)),
    "J dq/dx = identity": (J_rrr @ jax.jit(jax.jacobian(robot.inverse))(pose), jnp.eye(2)),
}
for name, (ours, theirs) in printed.items():
    error = jnp.max(jnp.abs(ours - theirs))
    print(f"{name:<22} greatest difference {error:.1e}")
    assert error < 1e-13

# %% [markdown]
# ## How well it moves at a pose
#
# Two local indices of $J$: the **isotropy** $1/\kappa = \sigma_{\min}/\sigma_{\max}$, 1 where the mechanism
# moves equally well in all directions and 0 at a singularity; and the **resistivity**
# $\omega = 1/|\det J|$, the paper's measure of stiffness, without bound where a leg is stretched or folded.
# (In the paper, the sentence after eq. 16 interchanges the two kinds of singularity.)

# %%
local = pk.local_indices(robot, jnp.stack([pose, stretched]))
for name, isotropy, resistivity, status in zip(("ordinary", "stretched"), *local, strict=True):
    print(f"{name:<10} isotropy {isotropy:.4f}  resistivity {resistivity:.4f}  {pk.Status(status).name}")

two_dof.local_index_figure(robot)

# %% [markdown]
# ## How well it moves on average, and how wrong a sum can be
#
# The global indices are means over the workspace $W$ (eqs. 23, 25), and the share of the enclosing box that
# $W$ fills (eq. 26):
#
# $$\mathrm{GII} = \frac1W\int_W \frac1\kappa\, dW,\qquad \mathrm{GRI} = \frac1W\int_W \omega\, dW,\qquad
# \mathrm{SUI} = \frac{W}{S}.$$
#
# Three rules compute them. `gauss` integrates by area and estimates its own error; `midpoint` is eq. (29)
# taken literally, with $M \times N$ nodes; `paper` is the discretization recovered from the printed tables:
# all radii of a sector weigh the same. Table 2 prints GII 0.57756 and GRI 2.424 for this design, and the
# text expects a numerical error within 3 %.

# %%
space = pk.design_space("2-rrr")  # designs as vectors (l_min, v), with la = 1 + v^2 and lb = l_min + 2 - la
papers_choice = space.mechanism(jnp.array([1.15, 0.0]))  # the same links: la = 1, lb = 2.15

gauss = pk.workspace_indices(papers_choice)
print("rule      nodes        GII       GRI       SUI       off by: GII       GRI")
print(f"gauss     24 x 24      {gauss.gii:.6f}  {gauss.gri:.6f}  {gauss.sui:.6f}", end="  ")
print(f"(estimates: {gauss.error.gii:.0e}, {gauss.error.gri:.0e})")

meshes = [(100, 150), (200, 300), (400, 600)]
off = []
for rule, nodes in [("paper", (50, 100)), *(("midpoint", mesh) for mesh in meshes)]:
    found = pk.workspace_indices(papers_choice, rule, nodes)
    off.append((found.gii / gauss.gii - 1, found.gri / gauss.gri - 1))
    values = f"{found.gii:.6f}  {found.gri:.6f}  {found.sui:.6f}"
    print(f"{rule:<9} {nodes[0]:>3} x {nodes[1]:<5}  {values}  {off[-1][0]:>13.2%}  {off[-1][1]:>8.2%}")

# %% [markdown]
# The resistivity grows like one over the square root of the distance to the boundary, where a leg is
# stretched or folded. That is why its mid-point sum gains only a factor $\sqrt2$ when $M$ doubles: the
# error of GRI falls like $M^{-1/2}$.

# %%
rings = np.array([mesh[0] for mesh in meshes])
gri_error = np.abs([gri for _, gri in off[1:]])
order, scale = np.polyfit(np.log(rings), np.log(gri_error), 1)
wanted = np.exp((np.log(1e-4) - scale) / order)
print(f"the error of GRI falls like M^{order:.3f}; 0.01 % would take M = {wanted:.1e}")
assert abs(order + 0.5) < 0.05

# %% [markdown]
# ## Gradients with respect to the design, and why the variable is $v$
#
# Eqs. (20) and (22) leave two free lengths: $l_{\min}$, and $l_a$ with $R \le l_a \le (l_{\min} + R)/2$.
# The design space writes $l_a = R\,(1 + v^2)$. The derivative of an index is one call of JAX away; here it
# stands beside central differences at an inner design.


# %%
def indices(vector, nodes=(24, 24)):
    """GII, GRI, SUI of a design."""
    found = pk.workspace_indices(space.mechanism(vector), nodes=nodes)
    return jnp.stack([found.gii, found.gri, found.sui])


gradients = jax.jit(jax.jacfwd(indices))  # (3, 2): rows GII, GRI, SUI; columns l_min, v

inside = jnp.array([1.6, 0.3])
steps = 1e-4 * jnp.eye(2)
central = np.stack([(indices(inside + h) - indices(inside - h)) / 2e-4 for h in steps], axis=1)
for name, exact, difference in zip(("GII", "GRI", "SUI"), gradients(inside), central, strict=True):
    print(f"d{name}/d(l_min, v)  autodiff {exact}  central differences {difference}")
assert np.allclose(gradients(inside), central, atol=1e-5)

# %% [markdown]
# Most optima lie on $l_a = R$. There the derivative with respect to $l_a$ is infinite, because
# $dv/dl_a = 1/(2v)$: the difference quotient below grows tenfold each time the step shrinks a hundredfold.
# In $v$ it settles on the number that automatic differentiation gives.

# %%
edge = jnp.array([1.15, 0.0])
at_edge, slope = indices(edge)[1], gradients(edge)[1, 1]
print("step h    [GRI(la = 1 + h) - GRI(la = 1)] / h    [GRI(v = h) - GRI(v = 0)] / h")
for h in (1e-2, 1e-4, 1e-6):
    in_la = (indices(edge.at[1].set(h**0.5))[1] - at_edge) / h
    in_v = (indices(edge.at[1].set(h))[1] - at_edge) / h
    print(f"{h:<8.0e}  {in_la:>37.3f}    {in_v:>29.6f}")
print(f"dGRI/dv at v = 0 by autodiff: {slope:.6f}")

# %% [markdown]
# ## The best design
#
# The composite index $\eta = w_1\hat\eta_1 + w_2\hat\eta_2 + w_3\hat\eta_3$ normalizes each index to
# $[0, 1]$ by its extremes over the design space (eq. 27). Those extremes are searched first and then
# frozen. Every search climbs by gradients from twelve starts spread over the space.

# %%
bounds = pk.index_bounds(space)
best = pk.optimize_design(space, (1, 1, 1), bounds=bounds)

for name, low, high in zip(("GII", "GRI", "SUI"), *bounds, strict=True):
    print(f"{name} lies between {low:.6f} and {high:.6f}")
print(f"l_min, v     {best.vector}: la = {best.mechanism.proximal:.6f}, lb = {best.mechanism.distal:.6f}")
print(f"composite    {best.objective:.9f}, at the paper's choice {pk.composite_index(gauss, bounds):.9f}")
print(f"status       {best.status.name}, KKT residual {best.kkt:.0e}, {best.evaluations_in_all} evaluations")
print(f"active       {best.active}, multipliers {best.multipliers}")

# %% [markdown]
# The multiplier of the active constraint $v \ge 0$ is a sensitivity: demand $v \ge \delta$ instead, and the
# best reachable composite index falls by $\lambda\delta$. We check it by solving the tightened problem:
# $v = \delta$, and $l_{\min}$ chosen anew by the secant method on $\partial\eta/\partial l_{\min} = 0$.

# %%
slopes = 1 / (bounds.upper - bounds.lower)  # of the composite index in GII, GRI, SUI
multiplier = best.multipliers["v = 0"]


def tightened(delta):
    """The best composite index with v = delta."""
    slope = lambda l_min: slopes @ gradients(jnp.array([l_min, delta]))[:, 0]
    before, l_min = best.vector[0], best.vector[0] + 1e-3
    for _ in range(4):
        a, b = slope(before), slope(l_min)
        before, l_min = l_min, l_min - b * (l_min - before) / (b - a)
    return pk.composite_index(indices(jnp.array([l_min, delta])), bounds)


print(f"multiplier lambda                  {multiplier:.6f}")
for delta in (1e-2, 1e-3, 1e-4):
    print(f"loss / delta for delta = {delta:.0e}     {(best.objective - tightened(delta)) / delta:.6f}")
longer = 0.001**0.5  # v of driven links that are longer by 0.1 %
print(f"la longer by 0.1 %, v = {longer:.4f}: loss {best.objective - tightened(longer):.4f}", end=", ")
print(f"lambda v = {multiplier * longer:.4f}")

# %% [markdown]
# So the loss goes with the square root of the excess of $l_a$ over $R$: at this optimum a small error of
# the driven links costs much. The map of $\eta$ over the feasible triangle shows the steep lower edge, and,
# in orange, the path of the best start.

# %%
share, l_min = np.meshgrid(np.linspace(0, 1, 21), np.linspace(1, 5, 49))
v = share * np.sqrt((l_min - 1) / 2)
designs = jnp.asarray(np.stack([l_min.ravel(), v.ravel()], axis=1))
cloud = jax.jit(jax.vmap(lambda vector: indices(vector, nodes=(8, 8))))(designs)  # (designs, 3)
surface = np.asarray(pk.composite_index(cloud, bounds)).reshape(l_min.shape)

path = best.history
figure = Figure(figsize=(11, 4), layout="compressed")
left, right = figure.subplots(1, 2, width_ratios=(3, 2))
optimum = (best.vector[0], float(best.mechanism.proximal), best.cpi)
two_dof.cpi_surface(l_min, 1 + v**2, surface, optimum, left)
left.plot(path.vector[:, 0], 1 + path.vector[:, 1] ** 2, "o-", color="#d55e00", mec="white")
right.semilogy(best.objective - path.objective + 1e-16, "o-", label="composite index still missing")
right.semilogy(path.stationarity, "s--", label="projected gradient")
right.set(xlabel="evaluation of value and gradient")
right.legend(frameon=False)
figure

# %% [markdown]
# ## One step beyond the paper: what the weights cannot reach
#
# The paper trades its indices by changing the weights. Sweep the weights between GII and GRI and draw the
# optima over the cloud of all designs. A design is *efficient* if no other is at least as good in both and
# better in one. The weighted sums miss most efficient designs: the front sags between its ends, and a
# weighted sum finds only what its convex hull touches.

# %%
sweep = [pk.optimize_design(space, (1 - w, w, 0), bounds=bounds) for w in (0, 0.1, 0.2, 0.5, 1)]
swept = np.array([(r.indices.gii, r.indices.gri) for r in sweep])
points = np.asarray(cloud[:, :2])
beaten = (points[None] >= points[:, None]).all(axis=2) & (points[None] > points[:, None]).any(axis=2)
front = points[~beaten.any(axis=1)]
front = front[np.argsort(front[:, 0])]

jump = int(np.argmax(np.diff(swept[::-1, 0])))
upper, lower = swept[::-1][jump : jump + 2]
missed = front[(front[:, 0] > upper[0]) & (front[:, 0] < lower[0])]
chord = upper[1] + (missed[:, 0] - upper[0]) / (lower[0] - upper[0]) * (lower[1] - upper[1])
print(f"the sweep jumps from GII, GRI = {upper.round(4)} to {lower.round(4)}")
print(f"efficient designs in between: {len(missed)}, below the chord: {(missed[:, 1] < chord).sum()}")

figure = Figure(figsize=(6, 4), layout="compressed")
ax = figure.subplots()
ax.plot(*points.T, ".", color="0.8", ms=4, label="designs")
ax.plot(*front.T, ".", color="#0072b2", ms=6, label="efficient designs")
ax.plot(*swept.T, "o", color="#d55e00", ms=7, mfc="none", mew=1.8, label="optima of weighted sums")
ax.plot(*np.stack([upper, lower]).T, "--", color="#d55e00", lw=1)
ax.set(xlabel="GII", ylabel="GRI", xlim=(0.5, 0.7), ylim=(0.7, 2.7))
ax.legend(loc="lower left")
figure

# %% [markdown]
# A compromise inside the gap has to be asked for in another way, for example as the greatest GRI subject to
# a required GII; the gradients above are all that such a search needs.
#
# What to take along: state the residual, let the derivatives follow; read the status of every row; do not
# trust a sum near a singular boundary; choose variables in which the problem is smooth; and read the
# multipliers, which put a price on every active constraint.
