"""What the command line says of assembly modes, and how they are drawn."""

import io
from pathlib import Path

import jax
import numpy as np
import pytest

import pk_jax as pk
from pk_jax.files import assembled
from pk_jax.viz.assembly import draw_modes

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

DIETMAIER = (1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071)  # the lengths of his forty postures
FIVE_BAR = 'family = "FiveBar"\nunit = "mm"\nhalf_base = 100\nproximal = 139\ndistal = 269\n'


@pytest.fixture(autouse=True)
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def forty():
    mech = pk.catalogued("dietmaier-40")
    return mech, np.array(DIETMAIER), pk.assembly_modes(mech, DIETMAIER)


def columns(text):
    """A CSV by names; numbers as floats."""
    header, *rows = [line.split(",") for line in text.splitlines()]
    each = dict(zip(header, zip(*rows, strict=True), strict=True))
    return {k: list(v) if k == "status" else np.array(v, float) for k, v in each.items()}


def table(out):
    """The printed table by names, as text; columns are three blanks apart."""
    head, *rows = [line.split("   ") for line in out.split("\n\n")[1].splitlines()[1:]]
    names = [name.strip() for name in head if name.strip()]
    cells = [[cell.strip() for cell in row if cell.strip()] for row in rows]
    return dict(zip(names, zip(*cells, strict=True), strict=True))


# --- six legs


def test_the_forty_postures_of_dietmaier(run, here, forty):
    _, lengths, modes = forty
    code, out, err = run(
        "modes",
        "dietmaier-40",
        "--lengths",
        *DIETMAIER,
        "-o",
        "modes.csv",
        "--figure",
        "modes.png",
        "--strict",
    )
    assert code == 0 and err == ""
    first = out.splitlines()
    assert first[0] == "dietmaier-40: 40 real modes"
    assert first[2] == "complete: all 40 solutions, real and complex, are accounted for"
    assert first[3] == "homotopy: 40 FINITE_REAL, retries 0"
    assert "joints: q1 1, q2 0.645275," in out
    shown = table(out)
    assert list(shown)[:7] == ["mode", "x", "y", "z", "rx", "ry", "rz"]
    at = np.array([shown[name] for name in "xyz"], float).T
    np.testing.assert_allclose(at, modes.poses.translation, rtol=1e-5, atol=1e-12)
    signs = [{"+": 1, "-": -1}[sign] for sign in shown["det A"]]
    np.testing.assert_array_equal(signs, modes.det_sign)
    assert set(shown["mirror"]) == {"none"} and "no" not in shown["certified within"]
    np.testing.assert_allclose(np.array(shown["sigma_min"], float), modes.sigma_min, rtol=5e-3)
    assert (here / "modes.png").read_bytes().startswith(b"\x89PNG") and sorted(
        p.name for p in here.iterdir()
    ) == ["modes.csv", "modes.png"]

    found = columns((here / "modes.csv").read_text())
    np.testing.assert_array_equal(found["mode"], np.arange(1, 41))
    assert set(found["status"]) == {"OK"} and set(found["row"]) == {1} and np.all(found["certified"] == 1)
    np.testing.assert_allclose(found["radius_m"], modes.radius, rtol=1e-12)
    assert run("ik", "dietmaier-40", "modes.csv", "-o", "lengths.csv", "--strict")[0] == 0  # as it is
    back = columns((here / "lengths.csv").read_text())
    for i, length in enumerate(lengths, 1):
        np.testing.assert_allclose(back[f"q{i}"], length, rtol=0, atol=1e-13)


def test_every_posture_is_drawn_at_one_scale(forty):
    mech, lengths, modes = forty
    figure = draw_modes(mech, lengths, modes)
    signs = {1: "+", -1: "\N{MINUS SIGN}"}
    titles = [ax.texts[0].get_text() for ax in figure.axes]
    assert titles == [f"mode {k}  ({signs[int(sign)]})" for k, sign in enumerate(modes.det_sign, 1)]
    assert len({(ax.get_xlim(), ax.get_ylim(), ax.get_zlim()) for ax in figure.axes}) == 1
    assert len({round(ax.get_position().x0, 9) for ax in figure.axes}) == 8  # columns
    for k, ax in enumerate(figure.axes):
        drawn = np.array(ax.lines[-1].get_data_3d()).T  # the joints of the platform
        expected = (
            modes.poses.translation[k] + np.asarray(mech.platform) @ np.asarray(modes.poses.rotation[k]).T
        )
        np.testing.assert_allclose(drawn, expected, atol=1e-12)
    colors = {(title[-2], ax.lines[-1].get_color()) for title, ax in zip(titles, figure.axes, strict=True)}
    assert len(colors) == len({color for _, color in colors}) == 2  # one a sign
    figure.draw_without_rendering()  # lines in space then have their projection as data
    for ax in figure.axes:
        inside = ax.get_position().transformed(figure.transFigure)
        for line in ax.lines:
            seen = line.get_transform().transform(np.column_stack(line.get_data()))
            seen = seen[np.all(np.isfinite(seen), axis=1)]
            assert np.all([inside.contains(*point) for point in seen])


def test_mirror_images_are_named(run):
    """A platform with flat base and platform: all modes come in pairs above and below."""
    out = run("modes", "semi-regular-stewart")[1]
    shown = table(out)
    height = np.array(shown["z"], float)
    partner = np.array(shown["mirror"], int) - 1
    assert len(height) % 2 == 0 and len(height) >= 2
    np.testing.assert_allclose(height, -height[partner], rtol=1e-5)
    np.testing.assert_array_equal(partner[partner], np.arange(len(height)))


# --- in the plane


def test_a_file_in_millimetres(run, here):
    """The end points are where circles of 269 mm about the elbows meet; angles are not scaled."""
    (here / "robot.toml").write_text(FIVE_BAR)
    code, out, _ = run("modes", "robot.toml", "--joints", "-4e-1", "2.5", "--output", "m.csv")
    assert code == 0 and "robot.toml: 2 real modes\njoints: q1 -0.4, q2 2.5\n" in out
    assert "complete: all 2 solutions of the closed form, real and complex" in out and "lengths in mm" in out
    shown, found = table(out), columns((here / "m.csv").read_text())
    for x, y in ((np.array(shown["x"], float), np.array(shown["y"], float)), (found["x_mm"], found["y_mm"])):
        for angle, base in ((-0.4, 100), (2.5, -100)):
            elbow = base + 139 * np.cos(angle), 139 * np.sin(angle)
            np.testing.assert_allclose(np.hypot(x - elbow[0], y - elbow[1]), 269, rtol=1e-5)
        assert np.hypot(x[1] - x[0], y[1] - y[0]) > 100
    assert shown["mirror"] == ("2", "1") and shown["det A"] in (("+", "-"), ("-", "+"))
    in_m = pk.assembly_modes(pk.load_mechanism("robot.toml"), [-0.4, 2.5])
    np.testing.assert_allclose(found["radius_mm"], 1e3 * in_m.radius, rtol=1e-12)


@pytest.mark.soak
def test_ways_from_home_are_told(run, monkeypatch):
    """Home is a mode of its own joints: the way to it is found; its image has the other sign."""
    out = run("modes", "5-link", "--connect", "-o", "m.csv")[1]
    found = columns(Path("m.csv").read_text())
    assert table(out)["from home"] == ("path", "no: det changes sign")
    assert found["to_home"].tolist() == [1, -1] == found["det_sign"].tolist()
    assert "from home" not in run("modes", "5-link")[1]
    links = np.array([1, 0, -1, 0, 1, 1])

    class Found:
        to_home = links

    monkeypatch.setattr(assembled, "connect_modes", lambda mech, joints, modes: Found)
    out = run("modes", "sauer-3-rpr", "--lengths", "5,5,3", "--connect")[1]
    assert table(out)["from home"] == ("path", "not found", "no: det changes sign", "not found")
    Path("rows.csv").write_text("5,5,3\n1,1,30\n")
    out = run("modes", "sauer-3-rpr", "--rows", "rows.csv", "--connect")[1]
    assert out.splitlines()[2].split() == ["row", "real", "expected", "status", "from", "home", "fates"]
    assert out.splitlines()[3].split()[:5] == ["1", "4", "6", "OK", "3"]  # as the stand-in says of any row


@pytest.mark.parametrize("source", ["file", "stdin"])
def test_rows_of_joints_have_a_line_each(run, here, monkeypatch, source):
    """The four postures of Sauer's platform; legs that cannot meet; joints that are none."""
    text = "t,q3,q1,q2\n0,3,5,5\n1,30,1,1\n2,nan,5,5\n"
    (here / "rows.csv").write_text(text)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    given = ("modes", "sauer-3-rpr", "--rows", "rows.csv" if source == "file" else "-", "-o", "m.csv")
    code, out, err = run(*given)
    assert code == 0 and "assembly modes: rows  3/3" in err
    assert "4 real modes of 3 rows of joints, 2 of them complete; closed form" in out
    lines = [line.split() for line in out.splitlines()[3:]]
    assert [line[:4] for line in lines] == [
        ["1", "4", "6", "OK"],
        ["2", "0", "6", "UNREACHABLE"],
        ["3", "0", "6", "BAD_INPUT"],
    ]
    assert lines[0][4:] == ["4", "FINITE_REAL,", "2", "FINITE_COMPLEX"]
    found = columns((here / "m.csv").read_text())
    assert found["status"] == ["OK"] * 4 + ["UNREACHABLE", "BAD_INPUT"]
    np.testing.assert_array_equal(found["row"], [1, 1, 1, 1, 2, 3])
    np.testing.assert_array_equal(found["mode"], [1, 2, 3, 4, 0, 0])
    assert np.all(np.isnan(found["x_m"][4:])) and np.all(np.isfinite(found["x_m"][:4]))
    (here / "good.csv").write_text("\n".join((here / "m.csv").read_text().splitlines()[:5]) + "\n")
    again = columns(run("ik", "sauer-3-rpr", "good.csv", "--strict")[1])
    np.testing.assert_allclose(
        [again[f"q{i}"] for i in (1, 2, 3)], np.repeat([[5], [5], [3]], 4, 1), atol=1e-12
    )


def test_columns_are_chosen(run, here):
    (here / "rows.csv").write_text("0,3,5,5\n")
    out = run("modes", "sauer-3-rpr", "--rows", "rows.csv", "--columns", "3,4,2")[1]
    assert "joints: q1 5, q2 5, q3 3\n" in out and out.startswith("sauer-3-rpr: 4 real modes\n")


def test_lengths_in_another_unit(run, here):
    """Those of the option and those of a file; angles stay what they are."""
    (here / "rows.csv").write_text("q1_mm,q2_mm,q3_mm\n5000,5000,3000\n")
    in_m = table(run("modes", "sauer-3-rpr", "--lengths", "5", "5", "3")[1])
    for given in (("--lengths", "5000", "5000", "3000"), ("--rows", "rows.csv")):
        code, out, _ = run("modes", "sauer-3-rpr", "--unit", "mm", *given, "-o", "m.csv")
        assert code == 0 and "joints: q1 5000, q2 5000, q3 3000\n" in out and "lengths in mm" in out
        shown, found = table(out), columns((here / "m.csv").read_text())
        for name, scale in (("x", 1000), ("y", 1000), ("phi", 1)):
            expected = scale * np.array(in_m[name], float)
            np.testing.assert_allclose(np.array(shown[name], float), expected, rtol=2e-5)
            np.testing.assert_allclose(found[f"{name}_{'mm' if scale > 1 else 'rad'}"], expected, rtol=2e-5)


def test_strict_asks_for_all(run, here):
    (here / "rows.csv").write_text("5,5,3\n1,1,30\n")
    assert run("modes", "sauer-3-rpr", "--rows", "rows.csv", "--strict")[0] == 0  # none is an answer
    code, out, _ = run("modes", "sauer-3-rpr", "--lengths", "1", "1", "30", "--strict")
    assert code == 0 and out.startswith("sauer-3-rpr: 0 real modes\n") and "mirror" not in out
    (here / "rows.csv").write_text("5,5,3\n5,5,-3\n")
    assert run("modes", "sauer-3-rpr", "--rows", "rows.csv", "--strict")[0] == 3
    assert run("modes", "sauer-3-rpr", "--rows", "rows.csv")[0] == 0


def test_why_they_may_not_be_all(run, monkeypatch):
    real = assembled.assembly_modes

    def doubtful(**changes):
        def modes(mech, joints, report=None):
            found = real(mech, joints)
            status = np.full_like(found.status, pk.Status.INCOMPLETE)
            return found._replace(is_complete=~found.is_complete, status=status, **changes)

        return modes

    lost = np.array([[0, 0, 0, 0, 3, 3]], np.int32)
    for changes, said in (
        ({"method": "search", "expected": np.array([-1])}, "a search from 256 poses cannot know whether"),
        ({"fates": lost}, "not complete: 2 paths lost, 6 solutions expected"),
        ({"method": "homotopy"}, "not complete: 6 solutions expected, and that number is not sure"),
    ):
        monkeypatch.setattr(assembled, "assembly_modes", doubtful(**changes))
        code, out, _ = run("modes", "sauer-3-rpr", "--lengths", "5", "5", "3", "--strict")
        assert code == 3 and said in out


# --- what is wrong


MISTAKES = {
    "wrong count": (
        ("dietmaier-40", "--lengths", "1", "2"),
        2,
        "--joints: there must be 6 (q1,q2,q3,q4,q5,q6)",
    ),
    "NaN": (
        ("sauer-3-rpr", "--lengths", "1", "nan", "2"),
        2,
        "--joints must be positive and finite, got 1,nan",
    ),
    "infinite angle": (("5-link", "--joints", "1", "inf"), 2, "--joints must be finite, got 1,inf"),
    "negative length": (("sauer-3-rpr", "--lengths", "1", "-2", "2"), 2, "must be positive and finite"),
    "length zero": (("sauer-3-rpr", "--lengths", "1", "0", "2"), 2, "must be positive and finite"),
    "a word": (
        ("sauer-3-rpr", "--lengths", "1", "two", "3"),
        2,
        "--joints: field 2 must be a number, got 'two'",
    ),
    "no joints": (("5-link", "--joints"), 2, "argument --joints/--lengths: expected one argument"),
    "no mechanism": (("--joints", "1"), 2, "required: mechanism"),
    "unknown mechanism": (("dietmaier",), 2, "did you mean 'dietmaier-40'?"),
    "missing file": (("robot2.toml",), 4, "No such file or directory: robot2.toml"),
    "missing rows": (("5-link", "--rows", "none.csv"), 4, "No such file or directory: none.csv"),
    "unknown unit": (("5-link", "--unit", "ft"), 2, "--unit must be one of m, mm"),
    "both": (
        ("5-link", "--rows", "a.csv", "--joints", "1", "2"),
        2,
        "--rows and --joints exclude each other",
    ),
    "figure of rows": (("5-link", "--rows", "a.csv", "--figure", "a.png"), 2, "--figure is for one row"),
    "columns of none": (("5-link", "--columns", "1,2"), 2, "--columns is for --rows"),
    "unknown picture": (("5-link", "--figure", "a.jpg"), 2, "--figure must end in .png, .svg or .pdf"),
    "into no folder": (("5-link", "-o", "none/m.csv"), 4, "none/m.csv"),
    "picture into no folder": (("5-link", "--figure", "none/m.png"), 4, "none/m.png"),
    "onto the rows": (("5-link", "--rows", "a.csv", "-o", "./a.csv"), 2, "./a.csv is the input file"),
    "onto the mechanism": (("robot.toml", "-o", "robot.toml"), 2, "robot.toml is the mechanism file"),
}


@pytest.mark.parametrize(("arguments", "code", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(run, here, arguments, code, expected):
    (here / "a.csv").write_text("1,2\n")
    (here / "robot.toml").write_text(FIVE_BAR)
    found, out, err = run("modes", *arguments)
    assert found == code and out == "" and expected in err
    assert len(err.splitlines()) == 1 and err.startswith("pk-jax") and len(err) < 400
    assert sorted(p.name for p in here.iterdir()) == ["a.csv", "robot.toml"]
    assert (here / "a.csv").read_text() == "1,2\n" and (here / "robot.toml").read_text() == FIVE_BAR


def test_no_posture_is_no_figure(run, here):
    code, _, err = run("modes", "sauer-3-rpr", "--lengths", "1", "1", "30", "--figure", "none.png")
    assert code == 2 and "at least one is real, got none" in err and not list(here.iterdir())
    mech = pk.catalogued("sauer-3-rpr")
    with pytest.raises(ValueError, match="of one row of joints, got 2 rows"):
        draw_modes(mech, [5, 5, 3], pk.assembly_modes(mech, [[5, 5, 3]] * 2))


# --- drawn in the plane


def test_panels_in_the_plane(run, here):
    code, _, _ = run("modes", "5-link", "--figure", "five.svg")
    text = Path("five.svg").read_text()
    assert code == 0 and "<svg" in text and text.count("mirror of") == 2
    mech = pk.catalogued("sauer-3-rpr")
    modes = pk.assembly_modes(mech, [5, 5, 3])
    figure = draw_modes(mech, np.array([5.0, 5, 3]), modes)
    assert len(figure.axes) == 4 and len({(ax.get_xlim(), ax.get_ylim()) for ax in figure.axes}) == 1
    for k, ax in enumerate(figure.axes):
        pose = jax.tree.map(lambda leaf, k=k: leaf[k], modes.poses)
        expected = np.asarray(mech.skeleton(pose, np.array([5.0, 5, 3])).points)[3:]
        np.testing.assert_allclose(np.array(ax.lines[-1].get_data()).T, expected)
        low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
        assert np.all((expected > low) & (expected < high)) and ax.get_aspect() == 1


def test_a_mechanism_that_does_not_name_its_platform_is_drawn_whole():
    mech = pk.catalogued("sauer-3-rpr")

    class Nameless:
        skeleton = mech.skeleton

    figure = draw_modes(Nameless, np.array([5.0, 5, 3]), pk.assembly_modes(mech, [5, 5, 3]))
    for ax in figure.axes:
        assert np.sum(np.isfinite(ax.lines[-2].get_data()[0])) == 2 * (3 + 3)  # legs, and the platform's rim
