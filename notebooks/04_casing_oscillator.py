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
# # Casing oscillator: a redundant carriage, every joint limited, and a proof
#
# A casing oscillator turns a steel tube into the ground. Four legs and a carriage hold its upper platform,
# whose tube passes through a guide at the origin $O$: the platform turns about $O$ and slides along its own
# axis. Nam, Bae and Park analysed its singularities and concluded that none lies in the workspace. Here
# that is *proved*, and the rest of the paper checked. Equations and figures of the paper are cited as "eq."
# and "Fig.". (The notebook takes about a minute, most of it compilation.)

# %%
# %matplotlib inline
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import pk_jax as pk
from pk_jax.papers import casing_oscillator as paper
from pk_jax.viz import casing_oscillator as viz
from pk_jax.viz.singularity import singular_configurations
from pk_jax.viz.workspace_map import draw_boundary, draw_map

pk.enable_x64()  # the caller decides about float64, before the first array
DEG = np.pi / 180

# %% [markdown]
# ## The machine
#
# A pose is an `AxisPose`: the slide $s$ along the casing and a rotation, four degrees of freedom. There are
# five joints: four leg lengths and the carriage position $E$, from which legs 1 and 4 start. The carriage
# is *kinematically redundant*: a pose leaves it free.

# %%
machine = pk.CasingOscillator()  # the machine of Table 1, in metres
pose, joints = machine.home()
print("neutral joints (mm):", np.round(1e3 * np.asarray(joints), 3))
print("freedoms, eq. (9):", paper.mobility(paper.BODIES, paper.JOINTS, paper.PASSIVE))
viz.model(machine, pose, joints).figure

# %% [markdown]
# Inverse kinematics takes the carriage as `free=`; forward kinematics takes all five lengths.

# %%
tilted = pk.AxisPose.from_angles(0.47, roll=0.10, pitch=0.02, yaw=-0.05)
ik = pk.inverse_kinematics(machine, tilted, free=[0.70, 0.73, 0.76])
fk = pk.forward_kinematics(machine, ik.joints)
print("joints (mm), three carriages:")
print(np.round(1e3 * np.asarray(ik.joints), 2))
print(
    "angles again:",
    np.round(np.asarray(fk.pose.angles()), 12)[0],
    [pk.Status(int(s)).name for s in fk.status],
)

# %% [markdown]
# ## Velocities and forces, with the carriage moving
#
# `velocity_jacobian` is the full $4\times5$ map. Moving the carriage at rest of the platform is a
# self-motion of legs 1 and 4. Statics is the same computation transposed: the rows of `screws` are the
# columns of the paper's matrix $S$, eq. (34), and the carriage must bear $f_1u_{1x} + f_4u_{4x}$.

# %%
q = ik.joints[0]
J = pk.velocity_jacobian(machine, tilted, q)
self_motion = pk.self_motions(machine, tilted, q)[0]
print("J", J.shape, " |J self-motion| =", f"{float(jnp.max(jnp.abs(J @ self_motion))):.0e}")

S = paper.statics_matrix(machine, tilted, q)
print(
    "S against the screws:", f"{float(jnp.max(jnp.abs(S.T - pk.screws(machine, tilted, q).lines[:4]))):.0e}"
)
A = pk.pose_jacobian(machine, tilted, q)
print("J_ex = diag(l) S^T: ", f"{float(jnp.max(jnp.abs(A - q[:4, None] * S.T))):.0e}")
forces = pk.joint_forces(
    machine, tilted, q, jnp.array([1000.0, 0.0, 50.0, 20.0])
)  # N along the axis, N m about O
print("joint forces (N): ", np.round(np.asarray(forces), 1))
assert jnp.max(jnp.abs(A - q[:4, None] * S.T)) < 1e-15

# %% [markdown]
# The Jacobian printed as eq. (18) leaves out what the slide moves sideways. Read in base axes it is wrong
# as soon as the casing leans; read in the casing's own frame it is exact.

# %%
for degrees in (0, 5, 15):
    lean = pk.AxisPose.from_angles(0.48, roll=degrees * DEG)
    q_lean = pk.inverse_kinematics(machine, lean).joints
    exact = pk.pose_jacobian(machine, lean, q_lean)
    printed = [
        paper.in_tangent(paper.printed_jacobian(machine, lean, q_lean, f), lean, f)
        for f in ("base", "casing")
    ]
    off = [float(jnp.max(jnp.abs(p - exact)) / jnp.max(jnp.abs(exact))) for p in printed]
    slide = paper.largest_misprint(machine, lean)
    print(f"roll {degrees:2} deg: base {off[0]:.1e} (rates of the slide {slide:.1%}), casing {off[1]:.0e}")

# %% [markdown]
# ## Workspace
#
# Every stroke and joint cone is a margin, dimensionless and $\geq 0$ inside. `travel` bisects one
# coordinate, `workspace_map` gives the smallest margin over two: a million poses in about a tenth of a
# second.

# %%
for name in ("roll", "pitch", "yaw"):
    ends = pk.travel(machine, name)
    limits = f"({ends.limit_lower}, {ends.limit_upper})"
    print(f"{name:5} {ends.lower / DEG:8.3f} .. {ends.upper / DEG:7.3f} deg", limits)
ends = pk.travel(machine, "pitch", free="any")
print(f"pitch {ends.lower / DEG:8.3f} .. {ends.upper / DEG:7.3f} deg with the carriage anywhere")

# %%
wide = [(-20 * DEG, 20 * DEG)] * 2
figure = Figure(figsize=(9.6, 3.9), layout="compressed")
for ax, other in zip(figure.subplots(1, 2), ("roll", "pitch"), strict=True):
    draw_map(pk.workspace_map(machine, (other, "yaw"), ranges=wide), ax)
    draw_boundary(
        pk.workspace_map(machine, (other, "yaw"), ranges=wide, free="any"), ax, color="#d55e00", linewidth=1.8
    )
    ax.set_title("black: carriage neutral; red: anywhere", fontsize="medium")
figure

# %% [markdown]
# ## Where to put the carriage
#
# `resolve_redundancy` puts the carriage where the smallest margin is greatest, or (`by="conditioning"`) where
# the platform is held best, by gradients; the result is differentiable in the pose and in the geometry.

# %%
steep = pk.AxisPose.from_angles(0.48, pitch=9 * DEG)
found = pk.resolve_redundancy(machine, steep)
print(f"E = {1e3 * float(found.free[0]):.3f} mm, smallest margin {float(found.value):.4f}")

# %% [markdown]
# ## Singularities
#
# $\det J_{ex} = 0$ in closed form: at roll 0 it factors into $\cos\psi\,\cos\theta\,(r\sin\theta -
# s\cos\theta)$ with yaw $\psi$ and pitch $\theta$, so the pitch branches do not depend on yaw, $E$ or $R$
# at all. The paper's text has roll $\pm90^\circ$ and pitch $\pm75^\circ$; the machine is singular at roll
# $\pm75.3^\circ$, pitch $\pm90^\circ$ and, not mentioned, pitch $62.5^\circ$.

# %%
for case in paper.singular_cases(machine):
    found = pk.classify_singularity(machine, case.pose, case.joints)
    dets = paper.determinants(machine, case.pose, case.joints)
    home = paper.determinants(machine, *machine.home())
    ratios = ", ".join(f"{float(a / b):9.1e}" for a, b in zip(dets, home, strict=True))
    kind = pk.SingularityKind(int(found.kind)).name
    print(f"{case.title:27} {kind:8} sigma {float(found.sigma_direct):.1e}  det {ratios}")

# %%
singular_configurations(paper.singular_cases(machine), columns=3)

# %% [markdown]
# Red is the axis about which the platform can still turn with all five joints locked; blue are the lines of
# the legs. `pk.singularity_locus(machine, "pitch,yaw")` follows the whole curves, `pk-jax reproduce
# casing-oscillator` draws them (Figs. 6 and 7).

# %% [markdown]
# ## The proof
#
# Sampling proves nothing. `certify_regular` bounds $A$ over boxes of poses by interval arithmetic with
# outward rounding until each is settled: over the whole box $|\det J_{ex}|/(4E^2Rrs^3)$, which is 1 at the
# neutral pose, exceeds one half. `certify_confined` proves that the strokes cannot let the machine out of
# that box: on no face are all kept, wherever the carriage is. Together: from its neutral pose the machine
# never meets a singularity.

# %%
proof = paper.prove_regular_workspace(machine)
for name, low, high in zip(proof.regular.names, proof.regular.lower, proof.regular.upper, strict=True):
    scale, unit = (1e-3, "mm") if name in "sE" else (DEG, "deg")
    print(f"{name:5} {low / scale:8.2f} .. {high / scale:7.2f} {unit}")
print(f"|det| > {proof.regular.bound:.4f}: {proof.regular.is_proved} ({proof.regular.boxes} boxes)")
print(f"no way out: {proof.confined.is_proved} ({proof.confined.boxes} boxes)")
assert proof.is_proved

# %% [markdown]
# It works for any mechanism whose equations intervals can follow, a Stewart platform about its home say:

# %%
hexapod = pk.catalogued("semi-regular-stewart")
box = {name: (-0.04, 0.04) for name in ("x", "y", "rx", "ry", "rz")}
found = pk.certify_regular(hexapod, box)
print(f"no singularity within 4 % of the base's radius and 0.04 rad: {found.is_proved} ({found.boxes} boxes)")
assert found.is_proved
