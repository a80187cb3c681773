"""The drawings show what the library computes, and leave matplotlib's global state alone."""

import io
import subprocess
import sys
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import pk_jax as pk
from pk_jax.analysis.workspace import workspace_indices
from pk_jax.viz import boundary as numbers
from pk_jax.viz import two_dof
from pk_jax.viz.skeleton import draw

TWO_RPR = pk.TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)
FIVE_BAR = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15)
BOTH = pytest.mark.parametrize("mech", [TWO_RPR, FIVE_BAR], ids=["2-rpr", "2-rrr"])
ROUNDOFF = 64 * float(jnp.finfo(jnp.zeros(()).dtype).eps)


def legs_of(mech, poses):
    """Distances of poses from the base joints. (..., 2) -> (..., 2)"""
    return np.linalg.norm(poses[..., None, :] - np.asarray(mech.base()), axis=-1)


def shoelace(polygon):
    """Area of a closed polygon (k, 2)."""
    x, y = polygon.T
    return abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def png(figure):
    stream = io.BytesIO()
    figure.savefig(stream, dpi=50)
    return stream.getvalue()


class Tripod:
    """Anything with a skeleton can be drawn."""

    points = np.array([[1.0, 0, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 2]])

    def skeleton(self, pose, joints):
        return pk.Skeleton(self.points, ((0, 3), (1, 3), (2, 3)), ground=(0, 1, 2))


# --- any mechanism


@pytest.mark.parametrize("mech", [TWO_RPR, FIVE_BAR, Tripod()], ids=["2-rpr", "2-rrr", "in space"])
def test_drawn_bars_end_where_the_skeleton_says(mech):
    pose = jnp.array([-0.5, 2.0])
    configuration = (None, None) if isinstance(mech, Tripod) else (pose, mech.inverse(pose))
    ax = draw(mech, *configuration, color="red", linewidth=3)
    skeleton = mech.skeleton(*configuration)
    points = np.asarray(skeleton.points)
    data = (line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data() for line in ax.lines)
    bars, ground, moving = (np.stack(coordinates, axis=-1) for coordinates in data)
    assert bars[~np.isnan(bars[:, 0])].reshape(-1, 2, points.shape[1]) == pytest.approx(
        points[np.asarray(skeleton.segments)]
    )
    assert ground == pytest.approx(points[list(skeleton.ground)])
    assert len(ground) + len(moving) == len(points)
    assert ax.lines[0].get_color() == "red" and ax.lines[0].get_linewidth() == 3
    png(ax.figure)


def test_draw_uses_the_axes_given_and_refuses_flat_ones_for_space():
    ax = Figure().add_subplot()
    assert draw(TWO_RPR, jnp.array([0.0, 2.0]), jnp.sqrt(jnp.array([5.0, 5.0])), ax) is ax
    with pytest.raises(ValueError, match="ax must be 3-D axes"):
        draw(Tripod(), None, None, ax)


# --- numbers behind the figures


@BOTH
def test_on_the_boundary_a_leg_is_at_its_limit(mech):
    least, most = (float(limit) for limit in numbers.leg_limits(mech))
    inner, outer = numbers.boundary(mech, numbers.boundary_angles(mech, 101))
    assert legs_of(mech, outer).max(axis=-1) == pytest.approx(np.full(101, most), rel=ROUNDOFF)
    assert legs_of(mech, inner).min(axis=-1) == pytest.approx(np.full(101, least), rel=ROUNDOFF)
    assert np.linalg.norm(outer - inner, axis=-1)[1:-1].min() > 0
    assert outer[0, 0] > 0 > outer[-1, 0]  # theta is positive to the left


def test_a_short_stroke_ends_in_a_corner_and_a_long_one_on_the_base_line():
    short = pk.TwoRPR(half_base=2.0, l_min=3.0, l_max=5.0)
    inner, outer = numbers.boundary(short, numbers.boundary_angles(short, 11))
    assert inner[[0, -1]] == pytest.approx(outer[[0, -1]], abs=1e-5)
    assert legs_of(short, inner[0]) == pytest.approx([3, 5], rel=1e-5)
    wide = pk.TwoRPR(half_base=1.0, l_min=1.5, l_max=5.0)
    inner, outer = numbers.boundary(wide, numbers.boundary_angles(wide, 11))
    assert (inner[-1], outer[-1]) == (pytest.approx([-2.5, 0], abs=1e-6), pytest.approx([-4, 0], abs=1e-6))


@pytest.mark.parametrize(
    ("mech", "message"),
    [
        (pk.FiveBar(half_base=1.0, proximal=1.2, distal=1.5), "least leg length >= half_base"),
        (Tripod(), "a TwoRPR or a FiveBar"),
    ],
)
def test_a_workspace_that_rays_do_not_describe_is_refused(mech, message):
    with pytest.raises(ValueError, match=message):
        two_dof.panoramic_figure(mech)


@BOTH
def test_the_outline_encloses_the_workspace(mech):
    assert shoelace(numbers.outline(mech)) == pytest.approx(float(workspace_indices(mech).area), rel=1e-3)


@BOTH
def test_indices_are_finite_inside_and_in_their_range(mech):
    isotropy, resistivity = two_dof.index_grid(mech, numbers.fitted_grid(mech))
    inside = np.s_[1:-1, 1:-1]
    assert np.isfinite(resistivity[inside]).all() and (resistivity[inside] > 0).all()
    assert (isotropy[inside] > 0).all() and (isotropy >= 0).all() and (isotropy <= 1 + ROUNDOFF).all()
    if isinstance(mech, pk.FiveBar):  # singular where a leg is stretched or folded
        assert isotropy[1:-1, [0, -1]] == pytest.approx(0, abs=1e-2)
        assert resistivity[1:-1, [0, -1]].min() > 100


def test_resistivity_of_the_2_rpr_is_the_sine_between_its_legs():
    poses = numbers.fitted_grid(TWO_RPR)
    _, resistivity = two_dof.index_grid(TWO_RPR, poses)
    sine = 2 * poses[..., 1] / legs_of(TWO_RPR, poses).prod(axis=-1)
    assert resistivity == pytest.approx(sine, abs=1e-5)


def test_driven_angles_of_the_2_rrr_are_continuous_and_mirror_images():
    theta = numbers.boundary_angles(FIVE_BAR, 721)
    for poses in numbers.boundary(FIVE_BAR, theta):
        angles = numbers.actuators(FIVE_BAR, poses)
        assert np.abs(np.diff(angles, axis=0)).max() < 10
        assert angles[:, 1] == pytest.approx(180 - angles[::-1, 0], abs=0.2)
        residual = jax.vmap(FIVE_BAR.residual)(jnp.asarray(poses), jnp.radians(angles))
        assert np.asarray(residual) == pytest.approx(0, abs=1e-5)


def test_the_image_of_the_workspace_in_the_driven_angles_has_the_area_of_its_resistivity():
    """omega dx dy = dphi1 dphi2, so the drawn region measures GRI times the workspace."""
    mech = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.5)
    ax = two_dof.joint_space_figure(l_min=1.5).axes[2]
    drawn = shoelace(np.radians(ax.patches[0].get_xy()))
    found = workspace_indices(mech)
    assert drawn == pytest.approx(float(found.gri * found.area), rel=2e-3)


# --- figures


@BOTH
def test_contours_stay_within_the_outline_and_reach_it(mech):
    figure = two_dof.local_index_figure(mech)
    edge = numbers.outline(mech)
    for ax in figure.axes[:2]:
        filled = np.concatenate([path.vertices for path in ax.collections[0].get_paths()])
        assert filled.min(axis=0) == pytest.approx(edge.min(axis=0), abs=1e-3)
        assert filled.max(axis=0) == pytest.approx(edge.max(axis=0), abs=1e-3)
    assert ("colours span 90%" in figure.axes[3].get_ylabel()) == isinstance(mech, pk.FiveBar)
    png(figure)


@BOTH
def test_panorama_and_actuators_follow_both_boundaries(mech):
    panorama = two_dof.panoramic_figure(mech, count=17)
    walks = numbers.boundary(mech, numbers.boundary_angles(mech, 17))
    for ax, poses in zip(panorama.axes, walks[::-1], strict=True):
        assert ax.lines[-1].get_xydata() == pytest.approx(poses, abs=1e-6)
    png(panorama)
    figure = two_dof.actuator_figure(mech)
    if isinstance(mech, pk.TwoRPR):
        curves = np.array([[line.get_ydata() for line in ax.lines] for ax in figure.axes])
        assert curves[0].max(axis=0) == pytest.approx(3, rel=ROUNDOFF)
        assert curves[1].min(axis=0) == pytest.approx(1, rel=ROUNDOFF)
    assert figure.axes[0].lines[0].get_xdata()[[0, -1]] == pytest.approx([-90, 90], abs=0.1)
    png(figure)


def test_composite_index_marks_the_optimum_and_leaves_nan_out():
    ax = Figure().add_subplot()
    assert two_dof.cpi_curve([1.0, 2.0, 3.0], [3.0, 1.0, 0.0], (1.0, 3.0), ax) is ax
    assert ax.lines[-1].get_xydata() == pytest.approx(np.array([[1, 3]]))
    l_min, la = np.linspace(1, 5, 41), np.linspace(1, 3, 21)
    cpi = np.where(la[:, None] <= (l_min + 1) / 2, 3 - l_min / 2 - la[:, None] / 4, np.nan)
    ax = two_dof.cpi_surface(l_min, la, cpi, (1.0, 1.0, 2.25))
    assert ax.lines[-1].get_xydata() == pytest.approx(np.array([[1, 1]]))
    filled = np.concatenate([path.vertices for path in ax.collections[0].get_paths()])
    assert (filled[:, 1] <= (filled[:, 0] + 1) / 2 + 1e-9).all()
    png(ax.figure)


def test_symbols_of_the_schematics_do_not_cover_each_other():
    figure = two_dof.mechanism_figure()
    figure.draw_without_rendering()
    symbols_of = "l_1 l_2 B_1 B_2 l_C theta R O", "phi_1 phi_2 d_1 d_2 l_a l_b l_C theta"
    for ax, symbols in zip(figure.axes, symbols_of, strict=True):
        words = [text for text in ax.texts if text.get_text()]
        assert all(any(symbol in text.get_text() for text in words) for symbol in symbols.split())
        boxes = [(text.get_text(), text.get_window_extent()) for text in words]
        covered = [(a, b) for (a, box), (b, other) in combinations(boxes, 2) if box.overlaps(other)]
        assert covered == []
    png(figure)


def test_joint_space_needs_legs_as_long_as_half_the_base():
    with pytest.raises(ValueError, match="l_min must be >= 1"):
        two_dof.joint_space_figure(l_min=0.5)


def test_matplotlib_is_imported_late_and_its_global_state_left_alone():
    program = """
import sys
import pk_jax as pk
assert "matplotlib" not in sys.modules, "import pk_jax imports matplotlib"
from matplotlib import rcParams
unread = "backend"  # reading it imports pyplot
settings = lambda: {name: rcParams[name] for name in rcParams if name != unread}
before = settings()
from pk_jax.viz import two_dof
two_dof.mechanism_figure().draw_without_rendering()
two_dof.cpi_surface([1, 2, 3], [1, 2], [[3, 2, 1], [2, 1, 0]], (1, 1, 3)).figure.draw_without_rendering()
assert "matplotlib.pyplot" not in sys.modules, "a figure imports pyplot"
assert settings() == before, "a figure changes rcParams"
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
