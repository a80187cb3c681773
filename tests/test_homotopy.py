"""Study coordinates, paths of a homotopy, and the start that monodromy finds."""

from __future__ import annotations

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pk_jax as pk
from pk_jax.geometry import rotations
from pk_jax.kinematics.modes import monodromy
from pk_jax.kinematics.modes import stewart as stewart_modes
from pk_jax.kinematics.modes.homotopy import End, Pencil, apart, follow
from pk_jax.kinematics.modes.monodromy import SOLUTIONS, between, generic_start, random_legs
from pk_jax.kinematics.modes.stewart import Layout
from pk_jax.kinematics.modes.study import NORM, PRODUCT, Legs, motion_of, point_of, quadrics

pytestmark = pytest.mark.usefixtures("compiled_in_haste")


# --- Study coordinates


def test_the_product_is_hamiltons():
    w, i, j, k = np.eye(4)
    times = lambda p, q: np.einsum("ijk,i,j->k", PRODUCT, p, q)
    for a, b, c in ((i, j, k), (j, k, i), (k, i, j), (w, i, i), (j, w, j), (i, i, -w), (j, i, -k)):
        assert np.array_equal(times(a, b), c)


@pytest.mark.soak
def test_a_leg_is_the_residual_as_a_quadratic_form():
    random = np.random.default_rng(0)
    base, platform = random.normal(size=(2, 6, 3))
    stewart = pk.Stewart(base=base, platform=platform)
    lengths = random.uniform(0.5, 2, 6)
    legs = Legs(base, platform, np.sum(base**2 + platform**2, axis=1) - lengths**2)
    for _ in range(5):
        shift, quaternion = random.normal(size=3), random.normal(size=4)
        z = point_of(shift, quaternion)
        forms = jnp.einsum("nij,i,j->n", quadrics(legs), z, z)
        pose = pk.SE3.from_quaternion(shift, quaternion)
        wanted = 2 * stewart.residual(pose, lengths) * np.sum(quaternion**2)
        np.testing.assert_allclose(forms[:6], wanted, rtol=0, atol=1e-13 * np.sum(quaternion**2) * 30)
        assert abs(forms[6]) < 1e-14 * np.sum(quaternion**2)


def test_points_and_motions_are_inverse_and_points_have_no_length():
    random = np.random.default_rng(1)
    shift, quaternion = random.normal(size=3), random.normal(size=4)
    for scale in (1.0, -2.0, 1j, 0.3 - 0.7j):
        translation, rotation = motion_of(scale * point_of(shift, quaternion))
        np.testing.assert_allclose(translation, shift, atol=1e-14)
        np.testing.assert_allclose(rotation, rotations.from_quaternion(jnp.asarray(quaternion)), atol=1e-14)


# --- paths: one quadric in P^1, z = (x, w), whose ends are known


def ends_of(at_start, at_end, points):
    """Q(s) = s at_start + (1 - s) at_end; w = 0 is at infinity."""
    forms = [jnp.asarray(form, complex)[None] for form in (at_start, at_end)]
    pencil = Pencil.through(forms[0], sum(forms) / 2, forms[1])
    padded = np.concatenate([np.asarray(points, complex), np.ones((3, 2))])
    wanted = np.arange(len(padded)) < len(points)
    return follow(pencil, jnp.diag(jnp.asarray([0.0, 1.0])), padded, wanted)


START = [[1.0, 0.2 + 0.1j], [0.2 + 0.1j, -1j]]  # x^2 + (0.4 + 0.2 i) x w - i w^2
ROOTS = np.stack([np.roots([1, 0.4 + 0.2j, -1j]), np.ones(2)], axis=1)


@pytest.mark.parametrize("roots", [(1, -1), (2 + 1j, -3), (1e-3, 1e3), (0, 5)])
def test_regular_ends(roots):
    total, product = sum(roots), np.prod(roots)
    found = ends_of(START, [[1, -total / 2], [-total / 2, product]], ROOTS)
    assert found.end[:2].tolist() == [End.REGULAR] * 2 and np.all(found.s[:2] == 0)
    wanted = np.stack([roots, np.ones(2)], axis=1) / np.sqrt(1 + np.abs(np.asarray(roots)[:, None]) ** 2)
    off = apart(wanted.astype(complex), np.asarray(found.point[:2]))
    assert np.sort(off.min(axis=1)).max() < 1e-12 and off.min(axis=0).max() < 1e-12


def test_points_of_unit_length_and_others_stay():
    found = ends_of(START, [[1, 0], [0, -1]], ROOTS)
    np.testing.assert_allclose(np.linalg.norm(found.point[:2], axis=1), 1, atol=1e-14)
    assert np.all(found.end[2:] == End.RUNNING) and np.all(found.steps[2:] == 0)


def test_a_root_at_infinity():
    found = ends_of(START, [[0, 0.5], [0.5, -1]], ROOTS)  # x w - w^2
    ends = sorted(found.end[:2].tolist())
    assert ends == [End.REGULAR, End.AT_INFINITY]
    x, w = found.point[np.argmax(found.end[:2] == End.REGULAR)]
    assert abs(x / w - 1) < 1e-12


def test_both_roots_at_infinity():
    found = ends_of(START, [[0, 0], [0, 1]], ROOTS)  # w^2
    assert found.end[:2].tolist() == [End.AT_INFINITY] * 2


@pytest.mark.parametrize("root", [1e5, 1e-5, 3e5j])
def test_large_roots_are_not_at_infinity(root):
    found = ends_of(START, [[1 / root, -0.5], [-0.5, 0]], ROOTS)  # x^2 / root - x w
    assert found.end[:2].tolist() == [End.REGULAR] * 2


def test_a_double_root_is_singular():
    found = ends_of(START, [[1, -2], [-2, 4]], ROOTS)  # (x - 2 w)^2
    assert found.end[:2].tolist() == [End.SINGULAR] * 2
    assert np.abs(found.point[:2, 0] / found.point[:2, 1] - 2).max() < 1e-3


def test_distances_are_of_lines_and_exact_when_small():
    random = np.random.default_rng(2)
    z = random.normal(size=(3, 8)) + 1j * random.normal(size=(3, 8))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    assert np.diagonal(apart(z, np.exp(0.7j) * z)).max() < 1e-15
    moved = z + 1e-11 * np.roll(z, 1, axis=0)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    overlap = np.sum(z.conj() * np.roll(z, 1, axis=0), axis=1)
    np.testing.assert_allclose(
        np.diagonal(apart(z, moved)), 1e-11 * np.sqrt(1 - abs(overlap) ** 2), rtol=1e-3
    )
    assert apart(np.eye(2), np.eye(2)).tolist() == [[0, 1], [1, 0]]


# --- the generic start


def test_the_start_solves_its_platform_forty_times():
    legs, points = generic_start()
    forms = np.einsum("nij,ki,kj->kn", np.asarray(quadrics(legs)), points, points)
    assert points.shape == (SOLUTIONS, 8) and np.abs(forms).max() < 1e-13
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-14)
    assert (apart(points, points) + np.eye(SOLUTIONS)).min() > 1e-3
    assert np.abs(np.einsum("ij,ki,kj->k", NORM, points, points)).min() > 1e-5


def test_a_loop_of_platforms_permutes_the_solutions():
    legs, points = generic_start()
    random = np.random.default_rng(3)
    route = [legs, random_legs(random), random_legs(random), legs]
    at = points
    for start, end in pairwise(route):
        paths = between(start, end, at, np.ones(SOLUTIONS, bool))
        assert np.all(np.asarray(paths.end) == End.REGULAR)
        at = np.asarray(paths.point)
    off = apart(points, at)
    image = off.argmin(axis=1)
    assert off.min(axis=1).max() < 1e-12 and sorted(image) == list(range(SOLUTIONS))
    assert image.tolist() != list(range(SOLUTIONS))


def test_one_point_on_a_random_platform():
    legs, point = monodromy._one_solution(np.random.default_rng(4))
    assert np.abs(np.einsum("nij,i,j->n", np.asarray(quadrics(legs)), point, point)).max() < 1e-14


@pytest.mark.soak
def test_the_start_is_made_anew(tmp_path):
    monodromy.write(tmp_path / "start.json")
    assert (tmp_path / "start.json").read_text() == monodromy.FILE.read_text()


@pytest.mark.soak
def test_another_seed_finds_forty():
    legs, points = monodromy.by_monodromy(seed=1)
    assert points.shape == (SOLUTIONS, 8)
    assert np.abs(np.einsum("nij,ki,kj->kn", np.asarray(quadrics(legs)), points, points)).max() < 1e-13


# --- layouts: what paths are lost is tried again, and never forgotten


@pytest.fixture
def general():
    return Layout(*np.random.default_rng(5).normal(size=(2, 6, 3)))


@pytest.fixture
def meddled(monkeypatch):
    """Change the paths of given calls of `between`: a function of (call, paths)."""

    def meddle(change):
        calls = []

        def changed(*arguments):
            calls.append(None)
            return change(len(calls) - 1, jax.device_get(between(*arguments)))

        monkeypatch.setattr(stewart_modes, "between", changed)
        return calls

    return meddle


def lost(paths, count):
    return paths._replace(end=np.where(np.arange(SOLUTIONS) < count, End.LOST, paths.end))


def jumped(paths):
    """The second path ends where the first does."""
    return paths._replace(point=np.concatenate([paths.point[:1], paths.point[:1], paths.point[2:]]))


LENGTHS = np.array([1.4, 1.1, 1.7, 1.3, 1.2, 1.5])


def test_forty_in_one_go(general, meddled):
    calls = meddled(lambda call, paths: paths)
    assert general.count() == (SOLUTIONS, True) and len(calls) == 1
    found = general.solve(LENGTHS)
    assert len(found.regular) == SOLUTIONS and found.is_complete and found.retries == 0 and len(calls) == 2


@pytest.mark.parametrize("spoil", [lambda paths: lost(paths, 3), jumped], ids=["lost", "jumped"])
def test_a_count_that_misses_paths_is_made_again(general, meddled, spoil):
    calls = meddled(lambda call, paths: spoil(paths) if call == 0 else paths)
    assert general.count() == (SOLUTIONS, True) and len(calls) == 3  # by way of another platform


def test_lost_paths_are_followed_from_another_start(general, meddled):
    meddled(lambda call, paths: lost(paths, 30) if call == 1 else paths)
    found = general.solve(LENGTHS)
    assert len(found.regular) == SOLUTIONS and found.is_complete and found.retries == 1


def test_a_path_that_jumped_is_noticed_and_its_conjugate_may_stand_in(general, meddled):
    meddled(lambda call, paths: jumped(paths) if call == 1 else paths)
    found = general.solve(LENGTHS)
    assert len(found.regular) == SOLUTIONS and found.is_complete


def test_conjugates_of_complex_solutions_stand_in_for_lost_paths(general, meddled):
    calls = meddled(lambda call, paths: lost(paths, 3) if call == 1 else paths)
    found = general.solve(LENGTHS)
    assert len(found.regular) == SOLUTIONS and found.is_complete and found.retries == 0 and len(calls) == 2


def test_a_path_that_ends_alone_on_a_singular_solution_was_misled(general, meddled):
    misled = lambda paths: paths._replace(end=np.where(np.arange(SOLUTIONS) == 0, End.SINGULAR, paths.end))
    meddled(lambda call, paths: misled(paths) if call == 1 else paths)
    found = general.solve(LENGTHS)
    assert len(found.regular) == SOLUTIONS and found.is_complete and not found.met


def test_what_stays_lost_is_said(general, meddled):
    general.count()
    meddled(lambda call, paths: lost(paths, 30))
    found = general.solve(LENGTHS)
    assert found.lost > 0 and not found.is_complete
    assert len(found.regular) + found.lost + found.at_infinity == SOLUTIONS


def test_a_count_that_is_never_clean_is_not_sure(meddled):
    layout = Layout(*np.random.default_rng(6).normal(size=(2, 6, 3)))
    meddled(lambda call, paths: lost(paths, 1))
    assert not layout.count()[1]
    assert not layout.solve(LENGTHS).is_complete


def test_two_counts_that_differ_are_not_sure(meddled):
    """One path of 40 called infinite by mistake in the first count only: the second has forty."""
    layout = Layout(*np.random.default_rng(7).normal(size=(2, 6, 3)))

    def one_leaves(call, paths):
        end = np.where(np.arange(SOLUTIONS) == 0, End.AT_INFINITY, paths.end)
        return paths._replace(end=end) if call == 0 else paths

    meddled(one_leaves)
    assert layout.count() == (SOLUTIONS, True)
    assert len(layout.start(0).points) == SOLUTIONS


def test_the_layout_does_not_depend_on_unit_or_frames():
    random = np.random.default_rng(8)
    base, platform = random.normal(size=(2, 6, 3))
    one, other = Layout(base, platform), Layout(1000 * base + 7, 1000 * platform - 3)
    for mine, others in zip(one.ends, other.ends, strict=True):
        np.testing.assert_allclose(mine, others, atol=1e-13)
    found = [each.solve(scale * LENGTHS).regular for each, scale in ((one, 1), (other, 1000))]
    assert apart(*found).min(axis=1).max() < 1e-9
