"""Mechanism files: what is saved is loaded, and every mistake is told in one line that names the file."""

import dataclasses
import os
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outsiders import Delta

import pk_jax as pk
from pk_jax.files import mechanism_file
from pk_jax.files.mechanism_file import load_mechanism, read_mechanism_file, save_mechanism
from pk_jax.mechanisms.stewart import Stewart

HEXAPOD = Path(__file__).parent.parent / "examples" / "hexapod.toml"
PLAIN = Stewart.semi_regular(0.3, 0.2, 0.1, 0.2)
AXES = np.broadcast_to(np.array([0.0, 0.6, 0.8]), (2, 6, 3))
MECHANISMS = {
    "Stewart": PLAIN,
    "Stewart full": Stewart(
        base=np.concatenate([PLAIN.base, [[0.1, -0.0, 1 / 3]]]),  # with a sensor
        platform=np.concatenate([PLAIN.platform, [[1e-17, 0.2, 5e-324]]]),
        stroke=np.stack([np.linspace(0.2, 0.25, 6), np.linspace(0.4, 0.5, 6)], axis=1),
        base_cone=np.pi,
        platform_cone=np.linspace(0.02, 1.1, 6),
        cone_axes=AXES,
    ),
    "FiveBar": pk.FiveBar(half_base=0.1, proximal=0.139, distal=0.269),
    "FiveBar full": pk.FiveBar(half_base=1.0, proximal=1.39, distal=2.69, reach=(2.08, 4.08)),
    "FiveBar coaxial": pk.FiveBar(half_base=0.0, proximal=0.23, distal=0.35),
    "PlanarRRR": pk.PlanarRRR(
        base=[[0.1, 1 / 3], [-0.3, -0.2], [0.4, -0.2]],
        platform=[[0.0, 0.1], [-0.1, -0.05], [0.1, -0.05]],
        proximal=[0.3, 0.31, 0.29],
        distal=0.3,
    ),
    "PlanarRPR": pk.PlanarRPR(
        base=[[0.0, 0.0], [2.5, 0.1], [1.25, 2.5]],
        platform=[[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]],
        stroke=(0.1, 3.0),
    ),
    "SixLink": pk.SixLink(
        base=[[-0.2, 0.0], [0.2, 0.0]], platform=[[-0.1, 0.0], [0.1, 0.0]], proximal=0.3, distal=(0.3, 1 / 3)
    ),
    "TwoRPR": pk.TwoRPR(half_base=1 / 3, l_min=0.1 + 0.2, l_max=1.0),
}
# the same five-bar in every unit
FIVE_BAR = {"m": 0.0254, "mm": 25.4, "cm": 2.54, "in": 1, "um": 25400.0, "1": 0.0254}


def fields(mech):
    return {f.name: getattr(mech, f.name) for f in dataclasses.fields(mech)}


def assert_same(found, expected):
    """The same class, fields, shapes, dtypes and bits."""
    assert type(found) is type(expected)
    for name, value in fields(expected).items():
        got = getattr(found, name)
        assert (got is None) == (value is None), name
        if value is not None:
            assert (got.shape, got.dtype) == (value.shape, value.dtype), name
            assert np.asarray(got).tobytes() == np.asarray(value).tobytes(), name


@pytest.fixture
def write(tmp_path):
    def write(content):
        path = tmp_path / "robot.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize("unit", FIVE_BAR)
@pytest.mark.parametrize("name", MECHANISMS)
def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path, name, unit):
    save_mechanism(MECHANISMS[name], tmp_path / "robot.toml", unit=unit)
    found = read_mechanism_file(tmp_path / "robot.toml")
    assert_same(found.mechanism, MECHANISMS[name])
    assert found.unit == unit


def test_the_default_unit_is_the_metre_and_none_is_left_out(tmp_path):
    save_mechanism(MECHANISMS["FiveBar"], tmp_path / "robot.toml")
    table = tomllib.loads((tmp_path / "robot.toml").read_text())
    assert table == {"family": "FiveBar", "unit": "m", "half_base": 0.1, "proximal": 0.139, "distal": 0.269}


def test_rows_are_written_one_a_line(tmp_path):
    save_mechanism(MECHANISMS["Stewart full"], tmp_path / "robot.toml", unit="mm")
    text = (tmp_path / "robot.toml").read_text()
    assert "\n    [100.0, -0.0, 333.3333333333333],\n]\nplatform = [\n" in text
    assert f"\nbase_cone = {np.pi!r}\n" in text and "platform_cone = [0.02, " in text  # radians, unscaled
    assert "        [0.0, 0.6, 0.8],\n" in text


@settings(max_examples=25)
@given(
    st.lists(st.floats(-0.02, 0.02), min_size=36, max_size=36),
    st.sampled_from(["m", "mm", "in", "um"]),
)
def test_random_platforms_come_back(tmp_path_factory, noise, unit):
    base, platform = np.asarray(noise).reshape(2, 6, 3)
    mech = Stewart(base=PLAIN.base + base, platform=PLAIN.platform + platform)
    path = tmp_path_factory.getbasetemp() / "random.toml"
    save_mechanism(mech, path, unit=unit)
    assert_same(load_mechanism(path), mech)
    # against plain arithmetic, which rounds once more than the file does
    scale = {"m": 1, "mm": 1000, "in": 1 / 0.0254, "um": 1e6}[unit]
    written = np.asarray(tomllib.loads(path.read_text())["base"], dtype=float)
    np.testing.assert_allclose(written, np.asarray(mech.base) * scale, rtol=1e-15, atol=0)


@pytest.mark.parametrize("unit", FIVE_BAR)
def test_a_length_is_the_same_in_every_unit(write, unit):
    length = FIVE_BAR[unit]
    path = write(
        f'family = "FiveBar"\nunit = "{unit}"\nhalf_base={length}\nproximal={length}\ndistal={3 * length}'
    )
    found = read_mechanism_file(path)
    assert float(found.mechanism.half_base) == 0.0254
    assert found.metres == {"m": 1, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "um": 1e-6, "1": 1}[unit]


def test_only_lengths_are_scaled(tmp_path, write):
    full = MECHANISMS["Stewart full"]
    save_mechanism(full, tmp_path / "metres.toml")
    text = (tmp_path / "metres.toml").read_text().replace('unit = "m"', 'unit = "mm"')
    found, lengths = load_mechanism(write(text)), ("base", "platform", "stroke")
    for name, value in fields(full).items():
        scale = 1e-3 if name in lengths else 1
        np.testing.assert_allclose(getattr(found, name), value * scale, rtol=1e-15, err_msg=name)


def test_every_field_of_every_family_is_known_to_be_a_length_or_not():
    """A new field must be looked at here, and in ANGLES, DIRECTIONS or NOT_IN_FILES if it is no length."""
    not_lengths = {*mechanism_file.ANGLES, *mechanism_file.DIRECTIONS, *mechanism_file.NOT_IN_FILES}
    known = {
        "Stewart": {"base", "platform", "stroke"},
        "CasingOscillator": {"base_radius", "platform_radius", "neutral", "stroke"},
        "PlanarRRR": {"base", "platform", "proximal", "distal"},
        "PlanarRPR": {"base", "platform", "stroke"},
        "SixLink": {"base", "platform", "proximal", "distal"},
        "FiveBar": {"half_base", "proximal", "distal", "reach"},
        "TwoRPR": {"half_base", "l_min", "l_max"},
    }
    assert set(known) == set(mechanism_file.FAMILIES)
    for family, lengths in known.items():
        names = {f.name for f in dataclasses.fields(mechanism_file.FAMILIES[family])}
        assert names - not_lengths == lengths


def test_the_example(tmp_path, write):
    found = read_mechanism_file(HEXAPOD)
    assert found.unit == "mm" and found.metres == 0.001
    table = tomllib.loads(HEXAPOD.read_text())
    assert table["base"][0] == [124.762, 32.11, 39.656] and table["platform"][5] == [57.865, -70.593, -25.603]
    # the same digits with the point moved are the same floats
    assert found.mechanism.base[0].tolist() == [0.124762, 0.03211, 0.039656]
    assert found.mechanism.platform[5].tolist() == [0.057865, -0.070593, -0.025603]
    save_mechanism(found.mechanism, tmp_path / "again.toml", unit="mm")
    again = tomllib.loads((tmp_path / "again.toml").read_text())
    assert again == {key: table[key] for key in ("family", "unit", "base", "platform")}


def test_what_toml_allows(write):
    path = write(
        b'\xef\xbb\xbf# with a mark, Windows lines and integers\r\nfamily = "TwoRPR"\r\nunit = "1"\r\n'
        b'name = "\xc3\xbc"\r\nsource = """two\r\nlines"""\r\n'
        b"half_base = 0x1\r\nl_min = 1_0.5e-1\r\nl_max = +3\r\n"
    )
    assert_same(load_mechanism(path), pk.TwoRPR(half_base=1.0, l_min=1.05, l_max=3.0))


def test_float32_is_written_short_and_read_as_float32_without_x64(tmp_path):
    with jax.enable_x64(False):
        mech = pk.TwoRPR(half_base=np.float32(1) / 3, l_min=0.1, l_max=1.0)
        for unit in ("m", "mm"):
            save_mechanism(mech, tmp_path / "robot.toml", unit=unit)
            assert_same(load_mechanism(tmp_path / "robot.toml"), mech)
            digits = {"m": "0.33333334", "mm": "333.33334"}[unit]
            assert f"half_base = {digits}\n" in (tmp_path / "robot.toml").read_text()
        (tmp_path / "big.toml").write_text('family="TwoRPR"\nunit="m"\nhalf_base=1e300\nl_min=1\nl_max=2')
        with pytest.raises(ValueError, match=r"TwoRPR\.half_base must be finite"):
            load_mechanism(tmp_path / "big.toml")


@pytest.mark.parametrize(
    "where", ["straße a/Ω b.toml", "~/home robot.toml", "a/../robot.toml", "~nobody-here"]
)
def test_paths(tmp_path, monkeypatch, where):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for folder in ("straße a", "a", "home"):
        (tmp_path / folder).mkdir()
    save_mechanism(MECHANISMS["TwoRPR"], where)
    there = tmp_path / where.replace("~/", "home/")
    assert there.is_file()
    assert_same(load_mechanism(where), MECHANISMS["TwoRPR"])
    assert_same(load_mechanism(there), MECHANISMS["TwoRPR"])  # os.PathLike
    there.write_text("family = 1")
    with pytest.raises(ValueError, match="family must be one of") as told:
        load_mechanism(where)
    assert str(told.value).startswith(where.replace("~/", f"{tmp_path}/home/") + ": ")


HEAD = 'family = "TwoRPR"\nunit = "m"\n'
REST = "half_base = 1.0\nl_min = 1.0\nl_max = 3.0\n"
TWO = HEAD + REST
SIX = "[[1,0,0],[0,1,0],[0,0,1],[1,1,0],[0,1,1],[1,0,1]]"
STEWART = 'family = "Stewart"\nunit = "mm"\n'


def _nested(depth):
    return "[" * depth + "]" * depth


WRONG = {
    "unknown key": (
        TWO + "speed = 1",
        "unknown key 'speed'; there are family, unit, name, source, half_base",
    ),
    "misspelt key": (TWO.replace("l_max", "L_mx"), r"unknown key 'L_mx' \(did you mean 'l_max'\?\)"),
    "misspelt family": (TWO.replace("family", "famliy"), r"unknown key 'famliy' \(did you mean 'family'\?\)"),
    "long key": (TWO + "x" * 999 + "=1", r"unknown key 'x{50,60}\.\.\.; there are"),
    "strange key": (TWO + '"a\\nb" = 1', r"unknown key 'a\\nb'; there"),
    "table": (TWO + "[geometry]\nbase = 1", "unknown key 'geometry'"),
    "slack": (
        'family = "FiveBar"\nunit = "m"\nhalf_base = 1\nproximal = 2\ndistal = 3\nslack = 1',
        "unknown key 'slack'",
    ),
    "no family": (
        REST,
        "missing key 'family', one of "
        '"Stewart", "CasingOscillator", "PlanarRRR", "PlanarRPR", "SixLink", "FiveBar", "TwoRPR"$',
    ),
    "empty": ("", "missing key 'family'"),
    "no unit": (
        'family = "TwoRPR"\n' + REST,
        'missing key \'unit\', one of "m", "mm", "cm", "in", "um", "1"$',
    ),
    "no length": (HEAD + "l_max = 3.0", "missing key 'half_base'; a TwoRPR needs half_base, l_min, l_max$"),
    "family": (
        TWO.replace("TwoRPR", "tworpp"),
        r"family must be one of .*got 'tworpp' \(did you mean 'TwoRPR'\?\)",
    ),
    "family list": (TWO.replace('"TwoRPR"', "[1.50]"), r"family must be one of .*got \[1.50\]$"),
    "unit": (TWO.replace('"m"', '"MM"'), r"unit must be one of .*got 'MM' \(did you mean 'mm'\?\)"),
    "unit 1": (TWO.replace('"m"', "1"), r"unit must be one of .*got 1 \(did you mean '1'\?\)"),
    "unit table": (TWO.replace('"m"', "{m = 1}"), r"unit must be one of .*got \{'m': 1\}$"),
    "name": ("name = 3\n" + TWO, "name must be a string, got 3$"),
    "source": ("source = ['a']\n" + TWO, r"source must be a string, got \['a'\]$"),
    "text": (TWO.replace("3.0", '"3.0"'), "l_max must be a number or an array of numbers, got '3.0'$"),
    "truth": (TWO.replace("3.0", "true"), "l_max must be a number or an array of numbers, got True$"),
    "date": (TWO.replace("3.0", "1979-05-27"), "l_max must be a number or an array .*got datetime.date"),
    "inner table": (
        TWO.replace("3.0", "{m = 3.50}"),
        r"l_max must be a number or an array .*got \{'m': 3.50\}$",
    ),
    "text within": (
        STEWART + "base = [[0,0,0],[0,'x',0]]\nplatform = 1",
        r"base\[1\]\[1\] must be a number, got 'x'$",
    ),
    "ragged": (
        STEWART + f"base = [[0,0,0],[0,0]]\nplatform = {SIX}",
        "base must have rows of one length, got",
    ),
    "mixed depth": (
        STEWART + f"base = [0,[0,0]]\nplatform = {SIX}",
        "base must have rows of one length, got",
    ),
    "nan": (TWO.replace("3.0", "nan"), "l_max must be finite, got nan$"),
    "inf": (TWO.replace("3.0", "-inf"), "l_max must be finite, got -inf$"),
    "inf within": (STEWART + "base = [[0,0,inf]]\nplatform = 1", r"base\[0\]\[2\] must be finite, got inf$"),
    "too large": (TWO.replace("3.0", "1e999999999999999999999"), "l_max must be finite, got inf$"),
    "too large integer": (TWO.replace("3.0", "1" * 400), "l_max must be finite, got inf$"),
    "far too large integer": (TWO.replace("3.0", "1" * 5000), "invalid TOML: .*4300 digits"),
    "vanishing": (
        TWO.replace("l_min = 1.0", "l_min = 0e-9999999999999999999"),
        "TwoRPR.l_min must be positive",
    ),
    "duplicate": (TWO + "l_max = 4.0", r"invalid TOML: Cannot overwrite a value \(at "),
    "syntax": (TWO + "l_max 4.0", r"invalid TOML: Expected '=' after a key.*\(at line 6"),
    "deep": (TWO.replace("3.0", _nested(5000)), "nested"),
    "dimensions": (TWO.replace("3.0", _nested(80)), "l_max must have rows of one length"),
    "latin-1": (b"# \xe9\n" + TWO.encode(), "must be UTF-8 text, .* at byte 2$"),
    "utf-16": (TWO.encode("utf-16"), "must be UTF-8 text, .* at byte 0$"),
    "binary": (b"\0" + TWO.encode(), r"invalid TOML: Invalid statement \(at line 1"),
    "5 MB": (TWO + "#" * 5_000_000, "must have at most 5000000 bytes"),
    "negative": (
        TWO.replace("half_base = 1.0", "half_base = -1"),
        r"TwoRPR.half_base must be positive, got -1.0$",
    ),
    "limits": (TWO.replace("3.0", "0.5"), "TwoRPR.l_max must exceed l_min = 1, got 0.5$"),
    "shape": (TWO.replace("3.0", "[3.0, 3.0]"), r"TwoRPR.l_max must have shape \(\), got \(2,\)$"),
    "reach": (
        'family = "FiveBar"\nunit = "mm"\nhalf_base=1e3\nproximal=1e3\ndistal=2e3\nreach=[3e3, 1e3]',
        r"FiveBar.reach must increase within .*got \[3, 1\] \(lengths in m\)$",
    ),
    "five rows": (STEWART + f"base = {SIX[:-9]}]\nplatform = {SIX}", "Stewart.base must have six rows"),
    "seven rows": (
        STEWART + f"base = {SIX[:-1]},[9,9,9]]\nplatform = {SIX}",
        r"Stewart.platform must have shape \(7, 3\)",
    ),
    "no rows": (
        STEWART + f"base = []\nplatform = {SIX}",
        r"Stewart.base must have shape \(any, 3\), got \(0,\)",
    ),
    "degrees": (
        STEWART + f"base = {SIX}\nplatform = {SIX}\nbase_cone = 30",
        r"base_cone must be at most pi, got 30: radians, not degrees\?$",
    ),
    "degrees within": (
        STEWART + f"base = {SIX}\nplatform = {SIX}\nplatform_cone = [1,1,1,1,1,45.0]",
        r"platform_cone must be at most pi, got \[1, 1, 1, 1, 1, 45.0\]: radians, not degrees\?$",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_mistake_is_told_in_one_line(write, name):
    content, expected = WRONG[name]
    path = write(content)
    with pytest.raises(ValueError, match=expected) as told:
        load_mechanism(path)
    message = str(told.value)
    assert type(told.value) is ValueError and message.startswith(f"{path}: ")
    assert "\n" not in message and len(message) < len(str(path)) + 410


def test_the_platform_itself_is_checked(tmp_path, write):
    save_mechanism(PLAIN, tmp_path / "good.toml", unit="mm")
    good = (tmp_path / "good.toml").read_text()
    for more, expected in {
        "stroke = [300, 200]": r"Stewart.stroke must be 0 < least < .*, got \[0.3, 0.2\] \(lengths in m\)$",
        "stroke = [0, 200]": "Stewart.stroke must be 0 < least < greatest",
        "base_cone = -0.1": r"Stewart.base_cone must be in \(0, pi\] rad",
        "stroke = [[1, 2]]": r"Stewart.stroke must have shape \(2,\) or \(6, 2\), got \(1, 2\)",
    }.items():
        path = write(good + more)
        with pytest.raises(ValueError, match=expected) as told:
            load_mechanism(path)
        assert str(told.value).startswith(f"{path}: Stewart.") and "\n" not in str(told.value)
    on_a_line = f"base = {[[i, i, i] for i in range(6)]}\n"
    path = write(good[: good.index("base =")] + on_a_line + good[good.index("platform =") :])
    with pytest.raises(ValueError, match=r"Stewart\.base must not have all six joints on one line"):
        load_mechanism(path)


def test_trouble_of_the_file_system_is_an_oserror(tmp_path):
    for path in (tmp_path, tmp_path / "missing.toml", tmp_path / "missing" / "x.toml"):
        with pytest.raises(OSError, match=str(path)):
            load_mechanism(path)
    for path in (tmp_path / "missing" / "x.toml", tmp_path):
        with pytest.raises(OSError):
            save_mechanism(MECHANISMS["TwoRPR"], path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="no endless file")
def test_an_endless_file_is_not_read_to_its_end():
    with pytest.raises(ValueError, match=r"^/dev/zero: .* must have at most 5000000 bytes"):
        load_mechanism("/dev/zero")


def test_a_failing_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "robot.toml"
    save_mechanism(MECHANISMS["FiveBar"], path)

    def stop(*_):
        raise OSError("disk full")

    for step in ("replace", "fsync"):
        monkeypatch.setattr(os, step, stop)
        with pytest.raises(OSError, match="disk full"):
            save_mechanism(MECHANISMS["TwoRPR"], path)
        monkeypatch.undo()
    assert_same(load_mechanism(path), MECHANISMS["FiveBar"])
    assert list(tmp_path.iterdir()) == [path]
    save_mechanism(MECHANISMS["TwoRPR"], path)
    assert_same(load_mechanism(path), MECHANISMS["TwoRPR"])


def test_slack_is_left_out(tmp_path):
    mech = pk.FiveBar(half_base=1.0, proximal=1.25, distal=2.0, slack=0.5)
    save_mechanism(mech, tmp_path / "robot.toml")
    assert_same(load_mechanism(tmp_path / "robot.toml"), pk.FiveBar(half_base=1.0, proximal=1.25, distal=2.0))


class Mine(pk.TwoRPR):
    pass


def test_the_unit_is_given_by_name(tmp_path):
    mech, path = MECHANISMS["TwoRPR"], tmp_path / "robot.toml"
    save_mechanism(mech=mech, path=path, unit="mm")
    assert read_mechanism_file(path).unit == "mm"
    with pytest.raises(TypeError):
        save_mechanism(mech, path, "mm")


def test_only_what_can_be_loaded_is_saved(tmp_path):
    path = tmp_path / "robot.toml"
    good = MECHANISMS["TwoRPR"]

    def refused(mech, expected, **kwargs):
        with pytest.raises(ValueError, match=expected) as told:
            save_mechanism(mech, path, **kwargs)
        assert str(told.value).startswith(f"{path}: ") and "\n" not in str(told.value)

    of_the_house = "only a mechanism of the house can be saved, {}, got ".format(
        "Stewart, CasingOscillator, PlanarRRR, PlanarRPR, SixLink, FiveBar, TwoRPR"
    )
    refused(Delta(base_radius=0.2, platform_radius=0.1, arm=0.3, rod=0.5), of_the_house + "Delta$")
    refused(Mine(**fields(good)), of_the_house + "Mine$")
    refused(None, of_the_house + "NoneType$")
    refused(good, r"unit must be one of .*got 'mmm' \(did you mean 'mm'\?\)", unit="mmm")
    refused(jax.tree.map(lambda leaf: leaf * np.nan, good), "TwoRPR.half_base must be finite, got nan")
    refused(jax.tree.map(lambda leaf: -leaf, good), "TwoRPR.half_base must be positive")
    refused(jax.tree.map(lambda leaf: leaf[None], good), r"TwoRPR.half_base must have shape \(\)")
    refused(jax.tree.map(lambda _: None, good), "missing key 'half_base'")
    refused(jax.tree.map(lambda _: object(), good), "TwoRPR.half_base must be real numbers")
    jax.jit(lambda mech: refused(mech, "of the house with known values can be saved, got a traced TwoRPR$"))(
        good
    )
    assert not path.exists()
