"""Global indices: oracles, published digits, error estimates, gradients, refusals."""

import subprocess
import sys
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from two_dof_oracles import duffy, equation_29, paper_rule

import pk_jax as pk
from pk_jax.analysis.workspace import workspace_area

SPACE, RPR = pk.design_space("2-rrr"), pk.design_space("2-rpr")
SQRT2 = np.sqrt(2)


def five_bar(l_min, v, half_base=1.0):
    la = 1 + v**2
    return pk.FiveBar(
        half_base=half_base,
        proximal=half_base * la,
        distal=half_base * (l_min + 2 - la),
        reach=(half_base * l_min, half_base * (l_min + 2)),
    )


def two_rpr(l_min, half_base=1.0):
    return pk.TwoRPR(half_base=half_base, l_min=half_base * l_min, l_max=half_base * (l_min + 2))


def triple(found):
    return jnp.stack([found.gii, found.gri, found.sui], axis=-1)


BLOCK = 32  # designs at once: a batch of every size goes through one compiled function


def in_blocks(function):
    """(designs, 2) -> what the function of one design gives of all, an array or a tuple of arrays."""
    block = jax.jit(jax.vmap(function))

    def many(designs):
        filled = np.concatenate([designs, np.tile(designs[-1], (-len(designs) % BLOCK, 1))])
        parts = [block(filled[i : i + BLOCK]) for i in range(0, len(filled), BLOCK)]
        return jax.tree.map(lambda *part: np.concatenate(part)[: len(designs)], *parts)

    return many


@cache
def batch(nodes=None, rule="gauss"):
    """(designs, 2) -> indices (designs, 3) and their estimated errors"""

    def one(z):
        found = pk.workspace_indices(SPACE.mechanism(z), rule, nodes)
        return triple(found), jnp.stack([found.error.gii, found.error.gri, found.error.sui])

    return in_blocks(one)


@cache
def slopes():
    return in_blocks(jax.jacfwd(lambda z: triple(pk.workspace_indices(SPACE.mechanism(z)))))


def scan():
    """Corners, edges, interior and both degenerate curves of eq. (22). -> (designs, 2)"""
    designs = []
    for l_min in np.concatenate([np.linspace(1, 5, 9), 1 + np.logspace(-6, -1, 4)]):
        top = np.sqrt((l_min - 1) / 2)
        designs += [(l_min, share * top) for share in (0, 1e-3, 0.1, 0.5, 0.9, 0.999, 1)]
        for offset in (0, 1e-4, -1e-3, 1e-2):
            for squared in ((l_min - SQRT2) / 2 + offset, (l_min + 1 - 2 * SQRT2) / (1 + SQRT2) + offset):
                if 0 <= squared <= top**2:
                    designs.append((l_min, np.sqrt(squared)))
    return np.array(designs)


# --- values


@pytest.mark.parametrize(("l_min", "la"), [(1, 1), (1.15, 1), (2.08, 1.39), (4, 2.1), (5, 3)])
def test_gauss_equals_a_rule_of_another_kind(l_min, la):
    found = pk.workspace_indices(five_bar(l_min, np.sqrt(la - 1)))
    gii, gri, area = duffy(l_min, la, l_min + 2 - la, 64)
    assert abs(found.gii - gii) < 5e-5  # conical points: the other rule is the inaccurate one
    assert abs(found.gri / gri - 1) < 5e-8  # at l_min = R the other rule has 3e-8
    assert abs(found.area / area - 1) < 1e-10


@pytest.mark.parametrize(
    ("design", "gii", "gri", "sui"),
    [
        (two_rpr(1), 0.5213190204, 0.7829910881, 0.4515420367),
        (two_rpr(3), 0.2272008754, 0.4295138550, 0.2376223059),
        (five_bar(1, 0), 0.5548434218, 2.4627478202, 0.4515420367),
        (five_bar(1.15, 0), 0.5991689832, 2.5684006684, 0.4168450007),
        (five_bar(2.08, np.sqrt(0.39)), 0.6897323171, 0.8815539900, 0.2988152178),
    ],
)
def test_true_integrals_of_the_printed_designs(design, gii, gri, sui):
    """Integrals of eqs. (23)-(26) that were computed by three other programs, to ten digits."""
    found = pk.workspace_indices(design)
    assert abs(found.gii / gii - 1) < 2e-9 and abs(found.gri / gri - 1) < 3e-8
    assert abs(found.sui - sui) < 5.1e-11  # the printed digits


def test_two_rpr_against_fine_midpoints_and_its_bounds():
    for l_min in (1.0, 1.3, SQRT2, 2.0, 3.0):
        found = pk.workspace_indices(two_rpr(l_min))
        gii, gri, area = equation_29(l_min, 400, 600)
        assert abs(found.gii - gii) < 2e-6 and abs(found.gri - gri) < 2e-6
        assert abs(found.area / area - 1) < 1e-5
        assert found.gri <= 2 * found.gii / (1 + found.gii**2)  # omega = 2 k / (1 + k^2), concave


def test_two_rpr_has_converged_to_machine_precision():
    for l_min in (1.0, 1.2, 1.41, 1.42, 2.5, 3.0):
        coarse = pk.workspace_indices(two_rpr(l_min))
        fine = pk.workspace_indices(two_rpr(l_min), nodes=(40, 30))
        np.testing.assert_allclose(triple(coarse), triple(fine), rtol=1e-12)
        assert coarse.error.gii < 1e-10


@pytest.mark.soak
def test_accuracy_and_error_estimate_over_the_whole_space():
    designs = scan()
    values, errors = batch()(designs)
    reference, _ = batch((44, 52))(designs)
    values, errors, reference = map(np.asarray, (values, errors, reference))
    true = np.abs(values - reference)
    assert np.max(true[:, 0] / reference[:, 0]) < 2e-9
    assert np.max(true[:, 1] / reference[:, 1]) < 3e-8
    assert np.max(true[:, 2] / reference[:, 2]) < 1e-12
    known = true - 2e-12 * reference * np.array([1, 1, 0])  # what the reference itself is sure of
    assert np.mean(known <= errors, axis=0).min() >= 0.99


def test_paper_rule_is_the_loop_of_the_paper():
    found = pk.workspace_indices(five_bar(2.08, np.sqrt(0.39)), "paper")
    np.testing.assert_allclose(triple(found), paper_rule(2.08, la=1.39, lb=2.69), rtol=1e-9)
    found = pk.workspace_indices(two_rpr(1.01), "paper")
    np.testing.assert_allclose(triple(found), paper_rule(1.01), rtol=1e-9)
    assert np.isnan(found.error.gii)


def test_paper_rule_gives_the_printed_digits():
    printed = {2.08: (1.39, 0.7078, 0.78609, 0.29929), 1.36: (1.0, 0.62059, 2.36238, 0.38094)}
    for l_min, (la, *cells) in printed.items():
        found = pk.workspace_indices(five_bar(l_min, np.sqrt(la - 1)), "paper")
        np.testing.assert_allclose(triple(found), cells, rtol=1e-5)


def test_midpoint_is_equation_29():
    found = pk.workspace_indices(five_bar(1.4, 0.3), "midpoint", (20, 30))
    gii, gri, area = equation_29(1.4, 20, 30, la=1.09, lb=2.31)
    np.testing.assert_allclose([found.gii, found.gri, found.area], [gii, gri, area], rtol=1e-10)


def test_midpoint_converges_like_the_root_of_its_rings():
    true = pk.workspace_indices(five_bar(2.08, np.sqrt(0.39))).gri
    errors = [
        abs(pk.workspace_indices(five_bar(2.08, np.sqrt(0.39)), "midpoint", nodes).gri / true - 1)
        for nodes in ((50, 300), (200, 300))
    ]
    assert 0.01 < errors[1] < 0.03 and 1.7 < errors[0] / errors[1] < 2.3


def test_area_against_a_polygon_and_its_derivative():
    for l_min in (1.0, 1.0001, 2.0, 5.0):
        theta = np.linspace(-np.pi / 2, np.pi / 2, 200_001)
        s, c = np.abs(np.sin(theta)), np.cos(theta)
        inner = s + np.sqrt(np.maximum(l_min**2 - c**2, 0))
        outer = -s + np.sqrt((l_min + 2) ** 2 - c**2)
        polygon = np.trapezoid(outer**2 - inner**2, theta) / 2
        assert abs(workspace_area(jnp.array(l_min)) / polygon - 1) < 1e-8
    slope = jax.grad(workspace_area)(2.0)
    central = (workspace_area(jnp.array(2.0001)) - workspace_area(jnp.array(1.9999))) / 2e-4
    assert abs(slope - central) < 1e-7
    one_sided = (workspace_area(jnp.array(1 + 1e-10)) - workspace_area(jnp.array(1.0))) / 1e-10
    assert abs(jax.grad(workspace_area)(1.0) - one_sided) < 1e-4


def test_scales_with_the_base():
    for make, power in ((lambda r: five_bar(1.7, 0.4, r), -2), (lambda r: two_rpr(1.7, r), 0)):
        small, large = pk.workspace_indices(make(1.0)), pk.workspace_indices(make(250.0))
        np.testing.assert_allclose(large.gii, small.gii, rtol=1e-9)
        np.testing.assert_allclose(large.gri, small.gri * 250.0**power, rtol=1e-9)
        np.testing.assert_allclose(large.sui, small.sui, rtol=1e-12)
        np.testing.assert_allclose(large.area, small.area * 250.0**2, rtol=1e-12)
        for rule in ("paper", "midpoint"):
            one, other = (pk.workspace_indices(make(r), rule, (12, 20)) for r in (1.0, 250.0))
            np.testing.assert_allclose(other.gri, one.gri * 250.0**power, rtol=1e-9)


# --- derivatives


@pytest.mark.soak
def test_gradients_against_central_differences():
    rng = np.random.default_rng(7)
    l_min = rng.uniform(1.1, 4.9, 32)
    v = rng.uniform(0.05, 0.95, 32) * np.sqrt((l_min - 1) / 2)
    la, lb = 1 + v**2, l_min + 1 - v**2
    away = np.minimum(abs(lb - la - SQRT2), abs(lb - SQRT2 * (1 + la))) > 0.03
    designs = np.stack([l_min, v], axis=1)[away]
    assert len(designs) > 20
    fine = lambda z: batch((44, 52))(z)[0]
    for j in range(2):
        step = 2e-4 * np.eye(2)[j]
        first = (fine(designs + step) - fine(designs - step)) / 4e-4
        second = (fine(designs + 2 * step) - fine(designs - 2 * step)) / 8e-4
        central = (4 * first - second) / 3
        assert np.max(np.abs(slopes()(designs)[:, :, j] - central)) < 1e-6


@pytest.mark.soak
def test_gradients_beside_a_degenerate_curve():
    """lb = sqrt 2 (1 + la): panel borders that followed the design there would miss by 1e-5."""
    designs = np.array([[2.1658333333333335, 0.37397623938651525], [2.315, 0.4490490886451058]])
    fine = lambda z: batch((44, 52))(z)[0]
    for j in range(2):
        step = 2e-4 * np.eye(2)[j]
        first = (fine(designs + step) - fine(designs - step)) / 4e-4
        second = (fine(designs + 2 * step) - fine(designs - 2 * step)) / 8e-4
        assert np.max(np.abs(slopes()(designs)[:, :, j] - (4 * first - second) / 3)) < 2e-6


@pytest.mark.soak
def test_gradients_are_finite_everywhere():
    assert np.all(np.isfinite(slopes()(scan())))


@pytest.mark.soak
def test_gradients_at_the_lower_limits_are_one_sided():
    """l_min = R and la = R are where most optima lie; a clipped function would halve them."""
    value = lambda l_min: pk.workspace_indices(two_rpr(l_min))
    slope = jax.grad(lambda l_min: value(l_min).gii)(1.0)
    h = 1e-4  # the second derivative is infinite: differences converge like h^(1/2)
    one_sided = (-3 * value(1.0).gii + 4 * value(1 + h).gii - value(1 + 2 * h).gii) / (2 * h)
    assert abs(slope / one_sided - 1) < 0.01
    inside = np.array([[1.7, 0.0]])  # the next term is v^2 log v: differences converge like h
    steps = np.array([[1.7, 0.0], [1.7, h], [1.7, 2 * h]])
    values = batch((44, 52))(steps)[0]
    one_sided = (-3 * values[0] + 4 * values[1] - values[2]) / (2 * h)
    np.testing.assert_allclose(slopes()(inside)[0, :, 1], one_sided, atol=1e-4)
    assert abs(slopes()(inside)[0, 1, 1]) > 0.1  # in la = 1 + v^2 the slope is infinite


def test_two_rpr_gradients():
    fine = lambda l_min: triple(pk.workspace_indices(two_rpr(l_min), nodes=(24, 24)))
    for l_min in (1.3, 1.7, 2.9):
        slope = jax.jacfwd(lambda x: triple(pk.workspace_indices(two_rpr(x))))(l_min)
        h = 1e-3
        stencil = sum(
            w * fine(l_min + k * h) for k, w in ((1, 45), (2, -9), (3, 1), (-1, -45), (-2, 9), (-3, -1))
        )
        np.testing.assert_allclose(slope, stencil / (60 * h), atol=1e-10)


@pytest.mark.soak
def test_gradient_of_a_mechanism_is_a_mechanism():
    mech = five_bar(2.0, 0.5)
    gradient = jax.grad(lambda m: pk.workspace_indices(m).gii)(mech)
    assert isinstance(gradient, pk.FiveBar)
    # along the designs of eq. (22): d/dv = 2 v (d/dla - d/dlb)
    chained = 2 * 0.5 * (gradient.proximal - gradient.distal)
    np.testing.assert_allclose(chained, slopes()(np.array([[2.0, 0.5]]))[0, 0, 1], rtol=1e-9)
    np.testing.assert_allclose(
        gradient.reach[0] + gradient.reach[1] + gradient.distal,
        slopes()(np.array([[2.0, 0.5]]))[0, 0, 0],
        rtol=1e-9,
    )


@pytest.mark.soak
def test_reverse_equals_forward_mode():
    value = lambda z: pk.workspace_indices(SPACE.mechanism(z)).gii
    z = jnp.array([2.3, 0.4])
    np.testing.assert_allclose(jax.jit(jax.grad(value))(z), slopes()(np.asarray(z)[None])[0, 0], rtol=1e-12)


def test_a_batch_equals_a_loop():
    designs = scan()[::9]
    values, _ = batch()(designs)
    looped = jnp.stack([triple(pk.workspace_indices(SPACE.mechanism(z))) for z in designs[:6]])
    np.testing.assert_allclose(values[:6], looped, rtol=1e-12)


# --- refusals


@pytest.mark.parametrize(
    ("mech", "words"),
    [
        (pk.TwoRPR(half_base=1, l_min=0.9, l_max=2.9), "l_min >= half_base, eq. (20)"),
        (pk.TwoRPR(half_base=1, l_min=1.5, l_max=3.0), "l_max = l_min + 2 half_base, eq. (20)"),
        (pk.FiveBar(half_base=1, proximal=1.39, distal=2.69), "l_max = l_min + 2 half_base, eq. (20)"),
        (
            pk.FiveBar(half_base=1, proximal=0.9, distal=2.6, reach=(1.7, 3.5)),
            "l_max = l_min + 2 half_base, eq. (20)",
        ),
        (
            pk.FiveBar(half_base=1, proximal=1.9, distal=2.1, reach=(2.0, 4.0)),
            "distal - proximal >= half_base, eq. (22)",
        ),
        (
            pk.FiveBar(half_base=1, proximal=1.3, distal=2.8, reach=(2.0, 4.0)),
            "proximal + distal = l_max, eq. (22)",
        ),
    ],
)
def test_designs_outside_the_equations_are_refused(mech, words):
    with pytest.raises(ValueError) as told:
        pk.workspace_indices(mech)
    assert words in str(told.value) and "\n" not in str(told.value)


def test_a_refused_design_under_vmap_is_told_and_hurts_no_other():
    def one(l_min):
        return pk.workspace_indices(pk.TwoRPR(half_base=1.0, l_min=l_min, l_max=l_min + 2))

    three = jax.jit(jax.vmap(one))
    good, mixed = three(jnp.array([1.2, 2.0, 2.5])), three(jnp.array([1.2, 0.5, 2.5]))
    assert list(mixed.status) == [pk.Status.OK, pk.Status.BAD_INPUT, pk.Status.OK]
    assert np.isnan(mixed.gii[1]) and np.isnan(mixed.area[1]) and np.isnan(mixed.error.gii[1])
    others = np.array([0, 2])
    np.testing.assert_array_equal(mixed.gii[others], good.gii[others])
    poisoned = three(jnp.array([1.2, jnp.nan, 2.5]))
    assert poisoned.status[1] == pk.Status.BAD_INPUT and np.all(np.isfinite(poisoned.gii[others]))


@pytest.mark.parametrize(
    "nodes", [(0, 8), (8, -1), (1, 8), (8,), (8, 8, 8), 8, (8.0, 8), ("8", 8), (True, 8), (8, 10**9)]
)
def test_bad_node_counts(nodes):
    for rule in ("gauss", "midpoint", "paper"):
        with pytest.raises(ValueError, match="nodes"):
            pk.workspace_indices(two_rpr(1.5), rule, nodes)


def test_unknown_rule_and_mechanism():
    with pytest.raises(ValueError, match="rule must be one of gauss, midpoint, paper, got 'simpson'"):
        pk.workspace_indices(two_rpr(1.5), "simpson")
    with pytest.raises(ValueError, match="takes a TwoRPR or a FiveBar, got str"):
        pk.workspace_indices("2-rpr")


@pytest.mark.soak
def test_single_precision():
    """Gauss and paper keep six digits; eq. (29) would be wrong without a word, and is refused."""
    code = (
        "import numpy as np, pk_jax as pk\n"
        "mech = pk.FiveBar(half_base=1, proximal=1.39, distal=2.69, reach=(2.08, 4.08))\n"
        "found = pk.workspace_indices(mech)\n"
        "assert found.gii.dtype == np.float32 and found.status == pk.Status.OK\n"
        "assert abs(found.gii - 0.6897323171) < max(1e-5, float(found.error.gii)) < 1e-4\n"
        "assert abs(found.gri - 0.8815539900) < 2e-5\n"
        "assert abs(pk.workspace_indices(mech, 'paper').gri - 0.786086) < 2e-5\n"
        "try: pk.workspace_indices(mech, 'midpoint')\n"
        "except ValueError as told: assert 'needs float64' in str(told)\n"
        "else: raise SystemExit('midpoint was not refused')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_batch_that_is_not_vmapped():
    several = jax.vmap(RPR.mechanism)(jnp.array([[1.2], [1.5]]))
    with pytest.raises(ValueError, match=r"takes one design; for a batch: jax\.vmap"):
        pk.workspace_indices(several)
    np.testing.assert_allclose(
        jax.vmap(pk.workspace_indices)(several).gii[1], pk.workspace_indices(two_rpr(1.5)).gii, rtol=1e-14
    )


def test_constructed_inside_jit():
    inside = jax.jit(lambda: pk.workspace_indices(two_rpr(1.5)).gii)()
    np.testing.assert_allclose(inside, pk.workspace_indices(two_rpr(1.5)).gii, rtol=1e-14)
