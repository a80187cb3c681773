"""Bad geometry is told at the door: one line, the field, what is allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pk_jax as pk
from pk_jax import checks

TWO_RPR = {"half_base": 1.0, "l_min": 1.0, "l_max": 3.0}
FIVE_BAR = {"half_base": 1.0, "proximal": 1.0, "distal": 2.15}

NOT_A_LENGTH = {
    "NaN": np.nan,
    "infinite": np.inf,
    "minus infinite": -np.inf,
    "negative": -1.0,
    "zero": 0.0,
    "a vector": [1.0, 2.0],
    "a vector of one": [1.0],
    "a matrix": np.ones((2, 2)),
    "empty": [],
    "ragged": [[1.0], [1.0, 2.0]],
    "a string": "1.0",
    "complex": 1.0 + 0.0j,
    "a bool": True,
    "an array of bools": np.array(True),
    "an object": object(),
    "None": None,
    "a dict": {"value": 1.0},
}
FIELDS = [(pk.TwoRPR, TWO_RPR, name) for name in TWO_RPR] + [(pk.FiveBar, FIVE_BAR, n) for n in FIVE_BAR]
each_field = pytest.mark.parametrize(
    ("mechanism", "good", "field"), FIELDS, ids=[f"{m.__name__}.{name}" for m, _, name in FIELDS]
)


def refused(build, *words, **fields):
    """The one-line message with which `build(**fields)` is refused."""
    with pytest.raises(ValueError) as caught:
        build(**fields)
    said = str(caught.value)
    assert "\n" not in said and len(said) < 250
    for word in words:
        assert word in said
    return said


@pytest.mark.parametrize("bad", NOT_A_LENGTH.values(), ids=NOT_A_LENGTH.keys())
@each_field
def test_every_length_is_checked(mechanism, good, field, bad):
    if mechanism is pk.FiveBar and field == "half_base" and bad is NOT_A_LENGTH["zero"]:
        assert float(mechanism(**{**good, field: bad}).length()) == good["proximal"]  # a coaxial five-bar
        return
    refused(mechanism, f"{mechanism.__name__}.{field} ", **{**good, field: bad})


@each_field
def test_a_missing_or_unknown_field_is_named(mechanism, good, field):
    with pytest.raises(TypeError, match=field):
        mechanism(**{name: value for name, value in good.items() if name != field})
    with pytest.raises(TypeError, match="lenght"):
        mechanism(**good, lenght=1.0)
    with pytest.raises(TypeError):
        mechanism(*good.values())


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"l_min": 3.0, "l_max": 1.0}, ("TwoRPR.l_max", "3", "1")),
        ({"l_min": 2.0, "l_max": 2.0}, ("TwoRPR.l_max", "l_min")),
        ({"l_min": 0.2, "l_max": 0.9}, ("TwoRPR.l_max", "half_base", "0.9")),
        ({"half_base": 4.0}, ("TwoRPR.l_max", "half_base")),
        ({"l_min": 0.5, "l_max": 1.0}, ("TwoRPR.l_max", "half_base")),
    ],
)
def test_a_stroke_must_let_the_legs_meet(wrong, words):
    refused(pk.TwoRPR, *words, **{**TWO_RPR, **wrong})


@pytest.mark.parametrize(
    "reach",
    [
        [2.0, 1.2],  # decreasing
        [2.0, 2.0],  # empty
        [1.0, 3.0],  # less than |lb - la| = 1.15
        [1.2, 3.2],  # more than la + lb = 3.15
        [np.nan, 3.0],
        [1.2, np.inf],
        [-1.2, 3.0],
        [1.2],
        1.2,
        [[1.2, 3.0]],
        [1.2, 2.0, 3.0],
        ["1.2", "3.0"],
        [1.2 + 0j, 3.0],
        [True, True],
    ],
)
def test_reach_lies_within_the_links(reach):
    refused(pk.FiveBar, "FiveBar.reach", reach=reach, **FIVE_BAR)


def test_reach_up_to_the_links_is_good():
    mech = pk.FiveBar(**FIVE_BAR, reach=[1.15, 3.15])
    np.testing.assert_array_equal(mech.limits(), [1.15, 3.15])


@pytest.mark.parametrize("links", [{"proximal": 0.3, "distal": 0.6}, {"proximal": 0.5, "distal": 0.5}])
def test_arms_too_short_to_meet_are_refused(links):
    refused(pk.FiveBar, "FiveBar.reach", "half_base", half_base=1.0, **links)


@pytest.mark.parametrize("slack", [0.5, -0.5, np.nan, np.inf, [0.0], "0", 0j, True])
def test_slack_belongs_to_the_proximal_link(slack):
    refused(pk.FiveBar, "FiveBar.slack", slack=slack, **FIVE_BAR)


def test_a_consistent_slack_is_good():
    mech = pk.FiveBar(half_base=2.0, proximal=2.5, distal=5.0, slack=0.5)  # 2.5 / 2 = 1 + 0.5^2
    assert mech.slack == 0.5


@pytest.mark.parametrize("one", [1, np.int32(1), np.float64(1), jnp.ones(()), np.array(1)])
def test_integers_and_arrays_are_numbers(one):
    mech = pk.TwoRPR(half_base=one, l_min=one, l_max=3 * one)
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(mech))
    assert [float(leaf) for leaf in jax.tree.leaves(mech)] == [1, 1, 3]


def test_float32_stays_float32():
    mech = pk.FiveBar(**{name: np.float32(value) for name, value in FIVE_BAR.items()})
    assert {leaf.dtype for leaf in jax.tree.leaves(mech)} == {jnp.dtype("float32")}


def test_under_jit_values_pass_and_shapes_do_not():
    build = jax.jit(lambda half_base: pk.TwoRPR(half_base=half_base, l_min=1.0, l_max=3.0))
    assert build(-1.0).half_base == -1.0  # no value is known there
    refused(build, "TwoRPR.half_base", "shape", half_base=jnp.ones(2))


def test_a_mechanism_is_frozen():
    mech = pk.TwoRPR(**TWO_RPR)
    with pytest.raises(AttributeError, match="half_base"):
        mech.half_base = 2.0


def test_a_mechanism_prints_its_fields():
    assert repr(pk.TwoRPR(**TWO_RPR)) == "TwoRPR(half_base=1.0, l_min=1.0, l_max=3.0)"
    assert "reach=None" in repr(pk.FiveBar(**FIVE_BAR))


class Bare(pk.TwoRPR):
    """A subclass adds a field of any shape; it is checked like the others."""

    offsets: jax.Array


@pytest.mark.parametrize("bad", [np.nan, [1.0, np.inf], "a", None, 1j])
def test_a_users_field_is_checked_too(bad):
    refused(Bare, "Bare.offsets ", **TWO_RPR, offsets=bad)


@pytest.mark.parametrize("bad", [0, -3, 1.0, 2.5, True, "3", None, np.nan, 11, 10**24])
def test_a_count_is_a_positive_integer(bad):
    with pytest.raises(ValueError, match=r"^nodes must be an integer from 1 to 10, got "):
        checks.is_count("nodes", bad, most=10)


@pytest.mark.parametrize("good", [1, 10, np.int64(3)])
def test_a_count_comes_back_as_int(good):
    counted = checks.is_count("nodes", good, most=10)
    assert counted == good and type(counted) is int


def test_a_long_value_is_cut_short():
    with pytest.raises(ValueError) as caught:
        checks.is_finite("lengths", np.full(1000, np.nan))
    assert len(str(caught.value)) < 120 and "\n" not in str(caught.value)


def test_sixty_characters_are_shown_and_no_more():
    assert checks.shown("x" * 58) == repr("x" * 58)
    assert checks.shown("x" * 59) == "'" + "x" * 56 + "..."
    assert checks.shown("a\n  b") == r"'a\n b'" and checks.shown(np.ones((2, 1))) == "array([[1.], [1.]])"


def test_a_shape_says_where_any_size_will_do():
    checks.has_shape("base", np.zeros((5, 3)), (None, 3))
    for shape in ((5, 2), (3,), (1, 5, 3)):
        with pytest.raises(ValueError) as caught:
            checks.has_shape("base", np.zeros(shape), (None, 3))
        assert str(caught.value) == f"base must have shape (any, 3), got {shape}"


def test_what_is_computed_from_known_values_is_known_within_jit_too():
    def known(x):
        assert checks.is_staged() and not checks.is_concrete(jnp.ones(3) * 2)
        with checks.known_values():
            assert checks.is_concrete(jnp.ones(3) * 2) and not checks.is_concrete(x)
        return x

    assert not checks.is_staged() and jax.jit(known)(1.0) == 1.0


@pytest.mark.parametrize("ratio", [1 / 101, 101.0, np.nan, np.inf, 0.0])
def test_units_that_differ_are_warned_of_where_the_caller_is(ratio):
    with pytest.warns(UserWarning, match="legs and base differ .* are they in one unit") as caught:
        checks.warn_of_units("legs and base", ratio, stacklevel=1)
    assert [warning.filename for warning in caught] == [__file__]
    for fine in (1 / 100, 1.0, 100.0):
        checks.warn_of_units("legs and base", fine, stacklevel=1)  # warnings are errors here


def test_zero_is_not_positive_and_a_bool_no_number():
    with pytest.raises(ValueError, match=r"^x must be positive, got \[1\. 0\.\]$"):
        checks.is_positive("x", np.array([1.0, 0.0]))
    assert [
        checks.is_number(x) for x in (10**24, 2.5, np.float32(3), True, np.nan, np.inf, "1", [1.0], 10**400)
    ] == ([True] * 3 + [False] * 6)


def test_what_does_not_fit_into_memory_is_told_with_its_size(monkeypatch):
    monkeypatch.setattr(checks, "_memory", lambda: 2e9)
    checks.fits("nodes = 9", 2e9, "take fewer")
    with pytest.raises(ValueError) as caught:
        checks.fits("nodes = 99", 2.5e9, "take fewer")
    assert str(caught.value) == "nodes = 99 would take 2.5 GB of memory, there are 2: take fewer"


def test_rows_need_four_times_their_size(monkeypatch):
    """For what is made of them."""
    monkeypatch.setattr(checks, "_memory", lambda: 4 * 8 * 100.0)
    checks.real_numpy("x", np.ones(100))
    with pytest.raises(ValueError, match=r"^x would take .* of memory"):
        checks.real_numpy("x", np.ones(101))


def test_a_container_may_have_less_memory_than_the_machine(monkeypatch, tmp_path):
    machine = checks._memory.__wrapped__()
    limits = tmp_path / "v2", tmp_path / "v1", tmp_path / "none"
    monkeypatch.setattr(checks, "_CGROUP", list(map(str, limits)))
    limits[0].write_text("max\n")
    limits[1].write_text("2000000\n")
    assert checks._memory.__wrapped__() == 2_000_000
    limits[1].write_text(f"{2**62}\n")  # that of a container without a limit
    assert checks._memory.__wrapped__() == machine


def test_a_word_is_one_of_those_there_are():
    assert checks.is_word("rule", "rays", ("rays", "panels")) == "rays"
    for bad in ("ray", "", None, 3, ["rays"]):
        with pytest.raises(ValueError, match=r"^rule must be one of rays, panels, got "):
            checks.is_word("rule", bad, ("rays", "panels"))


@pytest.mark.parametrize("good", [True, False, np.True_, np.False_])
def test_a_flag_is_true_or_false(good):
    assert checks.is_flag("certify", good) is bool(good)


@pytest.mark.parametrize("bad", [0, 1, "yes", None, 1.0, np.ones(1, bool)])
def test_what_is_neither_true_nor_false_is_no_flag(bad):
    with pytest.raises(ValueError, match=r"^certify must be True or False, got "):
        checks.is_flag("certify", bad)


def test_ranges_are_a_dict():
    assert checks.is_dict("ranges", {"x": (0, 1)}) == {"x": (0, 1)}
    for bad in (None, [("x", (0, 1))], "x"):
        with pytest.raises(ValueError, match=r"^ranges must be a dict, name -> \(lower, upper\), got "):
            checks.is_dict("ranges", bad)


def test_functions_may_be_left_out():
    checks.is_function("report", None)
    checks.is_function("report", print)
    for bad in ("print", 0, False, []):
        with pytest.raises(ValueError, match=r"^report must be a function or None, got "):
            checks.is_function("report", bad)


def test_words_are_a_string_or_a_sequence():
    assert checks.are_words("axes", "x,y") == ("x", "y") == checks.are_words("axes", ["x", "y"])
    for bad in (3, ["x", 1], None):
        with pytest.raises(ValueError, match=r"^axes must be names, got "):
            checks.are_words("axes", bad)


@pytest.mark.parametrize(
    "function", [pk.inverse_kinematics, pk.forward_kinematics, pk.local_indices], ids=lambda f: f.__name__
)
def test_what_is_no_mechanism_is_told(function):
    with pytest.raises(ValueError, match=rf"^{function.__name__} takes a pk_jax\.Mechanism, got int$"):
        function(3, [0.3, 2.2])


def test_devices_are_a_list_and_the_first_one_unless_given():
    first = jax.local_devices()[:1]
    assert checks.are_devices("devices", None) == first == checks.are_devices("devices", tuple(first))
    for bad in ("cpu", [0], first[0], [*first, None]):
        with pytest.raises(ValueError, match=r"^devices must be a list of jax\.devices\(\), got "):
            checks.are_devices("devices", bad)
    with pytest.raises(ValueError, match=r"^devices must hold at least one$"):
        checks.are_devices("devices", [])


def test_numbers_keep_their_precision_and_long_ones_become_float64():
    double = np.ones(3)
    assert checks.real_numpy("x", double) is double  # not even copied
    assert checks.real_numpy("x", np.ones(3, np.longdouble)).dtype == np.float64
    kept = jax.eval_shape(lambda x: checks.real_array("x", x), jax.ShapeDtypeStruct((3,), np.int32))
    assert kept.dtype == jnp.result_type(float)
    with pytest.raises(ValueError, match=r"^x must be real numbers, got complex"):
        jax.eval_shape(lambda x: checks.real_array("x", x), jax.ShapeDtypeStruct((3,), np.complex64))
