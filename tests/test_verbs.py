"""The verbs that take a mechanism: rows in, rows out, and one clear line for what is wrong."""

import io
import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

import pk_jax as pk

HEXAPOD = str(Path(__file__).parent.parent / "examples" / "hexapod.toml")
ROW = "169.252,169.355,169.785,168.888,168.418,169.185"  # of the log that hexapod.toml was identified from
POSE = (-0.579007, -0.96056, 215.757)  # what the same log says, mm
ANGLES = (0.241727, 0.133319, -0.173735)  # Rx Ry Rz, degrees
FIVE_BAR = 'family = "FiveBar"\nunit = "mm"\nhalf_base = 100\nproximal = 139\ndistal = 269\nname = "düne"\n'


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch):
    monkeypatch.setattr("pk_jax.cli._compile_cache", lambda: None)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder that is the working directory."""
    folder = tmp_path / "ein Ordner ü"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def table(text):
    """Columns by name; numbers as floats."""
    header, *rows = [line.split(",") for line in text.splitlines()]
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    return {k: list(v) if k == "status" else np.array(v, float) for k, v in columns.items()}


def rows(*columns):
    return "\n".join(",".join(map(repr, row)) for row in zip(*columns, strict=True)) + "\n"


# fk and ik


def test_fk_of_measured_rows(run, here):
    (here / "l.csv").write_text(f"t,l1_mm,l2_mm,l3_mm,l4_mm,l5_mm,l6_mm\n0,{ROW}\n1,nan{ROW[7:]}\n2,{ROW}\n")
    code, out, err = run("fk", HEXAPOD, "l.csv")
    found = table(out)
    assert code == 0 and list(found)[:10] == ["x", "y", "z", "qw", "qx", "qy", "qz", "rx", "ry", "rz"]
    assert list(found)[10:] == ["status", "residual", "steps", "sigma_min", "det_sign"]
    assert found["status"] == ["OK", "BAD_INPUT", "OK"]
    assert "3 rows: 2 OK, 1 BAD_INPUT;" in err
    numbers = [v for k, v in found.items() if k not in ("status", "steps")]
    assert np.all(np.isnan([v[1] for v in numbers])) and np.all(np.isfinite([v[[0, 2]] for v in numbers]))
    for name, expected in zip("xyz", POSE, strict=True):
        assert abs(found[name][0] - expected) < 0.02
    # about x, y and z of the fixed frame or of the moving one: the same to 1e-5 at such angles
    quaternion = [found[k][0] for k in ("qw", "qx", "qy", "qz")]
    vector = [found[k][0] for k in ("rx", "ry", "rz")]
    np.testing.assert_allclose(vector, np.deg2rad(ANGLES), atol=2e-4)
    half = np.linalg.norm(vector) / 2
    expected = [np.cos(half), *np.sin(half) / half / 2 * np.array(vector)]
    np.testing.assert_allclose(quaternion, expected, atol=1e-14)
    assert run("fk", HEXAPOD, "l.csv", "--strict")[0] == 3


def test_fk_certifies_on_request_in_the_unit_of_the_file(run, here):
    (here / "l.csv").write_text(f"l1_mm,l2_mm,l3_mm,l4_mm,l5_mm,l6_mm\n{ROW}\nnan{ROW[7:]}\n")
    found = table(run("fk", HEXAPOD, "l.csv", "--certify")[1])
    proved = pk.forward_kinematics(
        pk.load_mechanism(HEXAPOD), np.array(ROW.split(","), float) / 1000, certify=True
    )
    assert list(found)[-1] == "certified_within" and np.isnan(found["certified_within"][1])
    np.testing.assert_allclose(found["certified_within"][0], 1000 * float(proved.radius), rtol=0.3)
    assert 0 < found["certified_within"][0] < 1e-9
    assert run("fk", "nine-lengths", "l.csv", "--certify", "--closed-form")[0] == 2


@pytest.mark.parametrize("names", ["qw,qx,qy,qz", "rx,ry,rz", "both"])
def test_fk_of_ik_is_the_identity_in_space(run, here, names):
    rng = np.random.default_rng(5)
    count = 5
    where = rng.uniform(-10, 10, (count, 3)) + (0, 0, 200)
    vectors = rng.uniform(-0.2, 0.2, (count, 3))
    half = np.linalg.norm(vectors, axis=1, keepdims=True) / 2
    quaternions = np.concatenate([np.cos(half), np.sin(half) / half / 2 * vectors], axis=1)
    sizes = np.array([[1.0], [-3.0], [1e-200], [1e200], [0.5]])  # of any length, and q is -q
    header, numbers = {
        "qw,qx,qy,qz": ("qw,qx,qy,qz", [quaternions * sizes]),
        "rx,ry,rz": ("rx,ry,rz", [vectors]),
        "both": ("rx,ry,rz,qw,qx,qy,qz", [vectors + 1, quaternions]),  # the quaternion is used
    }[names]
    numbers = np.concatenate([where, *numbers], axis=1)
    (here / "p.csv").write_text(f"x_mm,y,z,{header}\n" + rows(*numbers.T.tolist()))
    (here / "plain.csv").write_text(rows(*numbers.T.tolist()))
    assert run("ik", HEXAPOD, "p.csv", "-o", "q.csv", "--strict")[0] == 0
    if names != "both":  # without a header the number of columns tells which it is
        assert run("ik", HEXAPOD, "plain.csv")[1] == (here / "q.csv").read_text()
    assert list(table((here / "q.csv").read_text())) == ["q1", "q2", "q3", "q4", "q5", "q6", "status"]
    assert run("fk", HEXAPOD, "q.csv", "-o", "again.csv", "--strict")[0] == 0
    found = table((here / "again.csv").read_text())
    np.testing.assert_allclose(np.transpose([found[k] for k in "xyz"]), where, atol=1e-9)
    np.testing.assert_allclose(np.transpose([found[k] for k in ("rx", "ry", "rz")]), vectors, atol=1e-11)
    found = np.transpose([found[k] for k in ("qw", "qx", "qy", "qz")])
    np.testing.assert_allclose(found, quaternions, atol=1e-11)
    assert sorted(p.name for p in here.iterdir()) == ["again.csv", "p.csv", "plain.csv", "q.csv"]


def test_a_half_turn_has_qw_not_negative(run, here):
    """Turned by more than pi / 2 the largest entry of the quaternion is not qw."""
    (here / "robot.toml").write_text(Path(HEXAPOD).read_text())
    from pk_jax.files.named import named_mechanism
    from pk_jax.files.stream import pose_columns

    angle = 3.0
    pose = pk.SE3.from_rotation_vector(np.zeros((2, 3)), np.array([[0, -angle, 0], [0, angle, 0]]))
    found = np.transpose(pose_columns(named_mechanism("robot.toml"), pose))
    expected = [[np.cos(angle / 2), 0, s * np.sin(angle / 2), 0, 0, s * angle, 0] for s in (-1, 1)]
    np.testing.assert_allclose(found[:, 3:], expected, atol=1e-14)


def test_poses_that_are_none(run, here):
    (here / "p.csv").write_text("1,2,200,0,0,0,0\n1,2,200,1,0,0,0\n1,2,200,nan,0,0,1\n1,2,200,inf,0,0,1\n")
    code, out, _ = run("ik", HEXAPOD, "p.csv", "--strict")
    found = table(out)
    assert code == 3 and found["status"] == ["BAD_INPUT", "OK", "BAD_INPUT", "BAD_INPUT"]
    assert np.array_equal(np.isfinite(found["q6"]), [False, True, False, False])


@pytest.fixture
def five_bar(here):
    (here / "fünf balken.toml").write_text(FIVE_BAR)
    return "fünf balken.toml"


def test_fk_of_ik_is_the_identity_in_the_plane(run, here, five_bar):
    """In mm; a pose out of reach hurts no other one."""
    x, y = [0.0, 30.0, 9000.0, -50.0], [200.0, 240.0, 0.0, 260.0]
    (here / "p ü.csv").write_text("y,x,remark\n" + rows(y, x, ["é"] * 4).replace("'", ""))
    code, out, err = run("ik", five_bar, "p ü.csv", "-o", "q ü.csv")
    assert code == 0 and out == "" and "4 rows: 3 OK, 1 UNREACHABLE" in err
    found = table((here / "q ü.csv").read_text())
    assert list(found) == ["q1", "q2", "status"] and found["status"][2] == "UNREACHABLE"
    code, out, _ = run("fk", five_bar, "q ü.csv")
    found = table(out)
    assert list(found)[:3] == ["x", "y", "status"]
    assert found["status"] == ["OK", "OK", "BAD_INPUT", "OK"]
    keep = [0, 1, 3]
    np.testing.assert_allclose(found["x"][keep], np.array(x)[keep], atol=1e-9)
    np.testing.assert_allclose(found["y"][keep], np.array(y)[keep], atol=1e-9)


def test_the_elbows_say_that_angles_are_not_scaled(run, here, five_bar):
    """The distal links close the loop, in the file's unit."""
    (here / "q.csv").write_text("0.4,2.5\n")
    found = table(run("fk", five_bar, "q.csv")[1])
    for angle, base in ((0.4, 100), (2.5, -100)):
        elbow = base + 139 * np.cos(angle), 139 * np.sin(angle)
        assert abs(np.hypot(found["x"][0] - elbow[0], found["y"][0] - elbow[1]) - 269) < 1e-9


@pytest.mark.parametrize("verb", ["fk", "ik"])
def test_chunks_change_no_byte(run, here, verb):
    rng = np.random.default_rng(7)
    lengths = rng.uniform(1.5, 2.5, (50, 2))
    lengths[17] = np.nan
    (here / "a.csv").write_text("# a comment\n" + rows(*lengths.T.tolist()).replace("\n", "\n\n", 20))
    whole = run(verb, "nam-2-rpr", "a.csv")[1]
    assert len(whole.splitlines()) == 51 and "BAD_INPUT" in whole.splitlines()[18]
    for chunk in ("1", "7", "16"):
        assert run(verb, "nam-2-rpr", "a.csv", "--chunk", chunk)[1] == whole
    assert run(verb, "nam-2-rpr", "a.csv", "-o", "b.csv", "--chunk", "7")[:2] == (0, "")
    assert (here / "b.csv").read_text() == whole


def test_units_of_a_catalogue_entry(run, here):
    (here / "m.csv").write_text("2,2\n")
    (here / "mm.csv").write_text("l1_mm,l2_mm\n2000,2000\n")
    in_m, in_mm = (table(run("fk", "nam-2-rpr", *a)[1]) for a in (["m.csv"], ["mm.csv", "--unit", "mm"]))
    assert abs(in_m["y"][0] - np.sqrt(3)) < 1e-14 and abs(in_mm["y"][0] - 1000 * np.sqrt(3)) < 1e-11
    code, out, err = run("fk", "nam-2-rpr", "mm.csv")
    assert (
        code == 2
        and out == ""
        and err
        == ("pk-jax: mm.csv:1: column 'l1_mm' is in mm, but what is read are lengths in m (see --unit)\n")
    )


def test_lengths_of_angles_are_none(run, here, five_bar):
    (here / "l.csv").write_text("l1,l2\n1,2\n")
    code, _, err = run("fk", five_bar, "l.csv")
    assert code == 2 and "no columns q1,q2 among" in err
    assert run("fk", five_bar, "l.csv", "--columns", "l1,l2")[0] == 0


def test_stdin_to_stdout(run, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"l1,l2\n2,2\n")))
    code, out, _ = run("fk", "nam-2-rpr", "-", "-o", "-")
    assert code == 0 and abs(table(out)["y"][0] - np.sqrt(3)) < 1e-14


def test_strict(run, here):
    (here / "a.csv").write_text("2,2\n0.1,0.1\n")  # the legs do not meet
    (here / "good.csv").write_text("2,2\n")
    assert run("fk", "nam-2-rpr", "good.csv", "--strict")[0] == 0
    assert run("fk", "nam-2-rpr", "a.csv")[0] == 0
    code, _, err = run("fk", "nam-2-rpr", "a.csv", "--strict", "-o", "b.csv")
    assert code == 3 and "1 UNREACHABLE" in err
    assert table((here / "b.csv").read_text())["status"] == ["OK", "UNREACHABLE"]


@pytest.mark.filterwarnings("default")
def test_lengths_in_another_unit_are_warned_of_in_one_line(run, here):
    (here / "a.csv").write_text("2000,9000\n" * 20)
    code, out, err = run("fk", "nam-2-rpr", "a.csv", "--chunk", "8")
    told = [line for line in err.splitlines() if "are they in one unit?" in line]
    assert code == 0 and out.count("UNREACHABLE") == 20
    assert len(told) == 1 and told[0].startswith("pk-jax: warning: joints and those of")


# What is wrong


@pytest.fixture
def folder(here):
    (here / "a.csv").write_text("2,2\n")
    (here / "bad.csv").write_text("2,2\n" * 9 + "2,two\n")
    (here / "robot.toml").write_text(FIVE_BAR)
    (here / "plain.toml").write_text(FIVE_BAR.replace('"mm"', '"1"'))
    (here / "broken.toml").write_text("family =")
    (here / "folder").mkdir()
    return here


MISTAKES = {
    "no mechanism": (["fk"], 2, "required"),
    "unknown mechanism": (["fk", "nam2rpr", "a.csv"], 2, "did you mean 'nam-2-rpr'?"),
    "quite unknown": (["ik", "zebra", "a.csv"], 2, "the catalogue has nam-2-rpr, nam-2-rrr"),
    "unknown to jacobian": (["jacobian", "nam-2-rpx"], 2, "did you mean 'nam-2-rpr'?"),
    "unknown to show": (["show", "nam-2-rpx"], 2, "did you mean 'nam-2-rpr'?"),
    "unknown to draw": (["draw", "nam-2-rpx", "-o", "a.png"], 2, "did you mean 'nam-2-rpr'?"),
    "missing file": (["fk", "robot2.toml", "a.csv"], 4, "No such file or directory: robot2.toml"),
    "broken file": (["fk", "broken.toml", "a.csv"], 2, "broken.toml: invalid TOML"),
    "folder as mechanism": (["fk", "folder", "a.csv"], 4, "Is a directory: folder"),
    "missing rows": (["fk", "nam-2-rpr", "b.csv"], 4, "No such file or directory: b.csv"),
    "folder as rows": (["fk", "nam-2-rpr", "folder"], 4, "Is a directory"),
    "a word": (["fk", "nam-2-rpr", "bad.csv"], 2, "bad.csv:10: field 2 (q2) must be a number, got 'two'"),
    "wrong number of columns": (
        ["ik", HEXAPOD, "a.csv"],
        2,
        "a.csv:1: there must be 6 (x,y,z,rx,ry,rz) or 7",
    ),
    "unknown unit": (["fk", "nam-2-rpr", "a.csv", "--unit", "ft"], 2, "--unit must be one of m, mm, cm"),
    "unit of a file without": (["fk", "plain.toml", "a.csv", "--unit", "mm"], 2, "have no unit"),
    "no chunk": (["fk", "nam-2-rpr", "a.csv", "--chunk", "0"], 2, "--chunk must be at least 1, got 0"),
    "onto the input": (["fk", "nam-2-rpr", "a.csv", "-o", "folder/../a.csv"], 2, "is the input file"),
    "onto the mechanism": (["fk", "robot.toml", "a.csv", "-o", "robot.toml"], 2, "is the mechanism file"),
    "onto a folder": (["fk", "nam-2-rpr", "a.csv", "-o", "folder"], 4, "Is a directory: folder"),
    "into no folder": (["fk", "nam-2-rpr", "a.csv", "-o", "none/b.csv"], 4, "none/b.csv"),
    "into a file": (["fk", "nam-2-rpr", "a.csv", "-o", "a.csv/b.csv"], 4, "a.csv/b.csv"),
    "unwritable folder": (["fk", "nam-2-rpr", "a.csv", "-o", "/proc/b.csv"], 4, "/proc/b.csv"),
    "unknown picture": (
        ["draw", "nam-2-rpr", "-o", "a.jpg"],
        2,
        "-o must end in .png, .svg or .pdf, got 'a.jpg'",
    ),
    "picture of nothing": (["draw", "nam-2-rpr", "--pose", "1,x", "-o", "a.png"], 2, "--pose: field 2"),
    "picture into no folder": (["draw", "nam-2-rpr", "-o", "none/a.png"], 4, "none/a.png"),
    "pose without end": (
        ["jacobian", "nam-2-rpr", "--pose", "1"],
        2,
        "--pose: there must be 2 (x,y) columns",
    ),
    "names as pose": (["jacobian", "nam-2-rpr", "--pose", "x,y"], 2, "--pose: 'x' must be a number"),
    "pose that is none": (["jacobian", "nam-2-rpr", "--pose", "nan,1"], 2, "--pose nan,1 is BAD_INPUT"),
    "pose out of reach": (
        ["jacobian", "robot.toml", "--pose", "-9000,1"],
        2,
        "--pose -9000,1 is UNREACHABLE",
    ),
    "pose left out": (["jacobian", "nam-2-rpr", "--pose"], 2, "expected one argument"),
}


@pytest.mark.parametrize(("arguments", "code", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(run, folder, arguments, code, expected):
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    found, out, err = run(*arguments)
    assert found == code and out == ""
    assert expected in err and len(err.splitlines()) == 1 and err.startswith("pk-jax") and len(err) < 400
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before
    assert not any((folder / "folder").iterdir())


def test_a_file_that_breaks_off_leaves_no_output(run, folder):
    """In a later chunk, when rows have been written."""
    (folder / "out.csv").write_text("old")
    code, _, err = run("fk", "nam-2-rpr", "bad.csv", "-o", "out.csv", "--chunk", "4")
    assert code == 2 and "bad.csv:10:" in err and (folder / "out.csv").read_text() == "old"
    assert not list(folder.glob(".*"))


@pytest.mark.parametrize(
    ("stop", "code"),
    [
        (lambda: signal.raise_signal(signal.SIGINT), 130),
        (lambda: signal.raise_signal(signal.SIGTERM), 130),
        (lambda: signal.raise_signal(signal.SIGHUP), 130),
        (lambda: (_ for _ in ()).throw(OSError(28, "No space left on device")), 4),
    ],
)
def test_a_run_that_is_stopped_leaves_no_output(run, folder, monkeypatch, stop, code):
    from pk_jax.files import stream

    real, calls, seen = stream.format_rows, [], []

    def second_stops(columns):
        calls.append(1)
        seen.extend(folder.glob(".*.part"))
        if len(calls) == 2:
            stop()
        return real(columns)

    monkeypatch.setattr(stream, "format_rows", second_stops)
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {each: signal.signal(each, how) for each, how in usual.items()}  # nohup and & ignore some
    (folder / "a.csv").write_text("2,2\n" * 9)
    handlers = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGHUP)]
    found, out, err = run("fk", "nam-2-rpr", "a.csv", "-o", "out.csv", "--chunk", "4")
    kept = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGHUP)]
    for each, how in before.items():
        signal.signal(each, how)
    assert found == code and out == "" and len(calls) == 2 and seen
    assert len(err.splitlines()) == 1
    assert not list(folder.glob(".*")) and not (folder / "out.csv").exists()
    assert kept == handlers


def test_a_path_that_only_looks_like_a_catalogue_entry(run, folder):
    """The catalogue comes first; any other file that is there is a mechanism file."""
    (folder / "nam-2-rpr").write_text(FIVE_BAR)
    (folder / "arm").write_text(FIVE_BAR)
    assert "family TwoRPR" in run("show", "nam-2-rpr")[1]
    assert "family FiveBar" in run("show", "arm")[1] and "family FiveBar" in run("show", "./nam-2-rpr")[1]


# jacobian, draw, show


def test_jacobian(run):
    """J of the 2-RPR by hand: the rows of J^-1 are the unit vectors along the legs."""
    code, out, _ = run("jacobian", "nam-2-rpr", "--pose", "-0.5,1.5", "--json")
    found = json.loads(out)
    legs = np.array([[-0.5 - 1, 1.5], [-0.5 + 1, 1.5]])
    lengths = np.linalg.norm(legs, axis=1)
    assert code == 0 and found["pose"] == {"x": -0.5, "y": 1.5} and found["unit"] == "m"
    np.testing.assert_allclose([found["joints"]["q1"], found["joints"]["q2"]], lengths, rtol=1e-14)
    np.testing.assert_allclose(np.linalg.inv(found["j"]), legs / lengths[:, None], atol=1e-14)
    np.testing.assert_allclose(found["a"], legs, atol=1e-14)
    np.testing.assert_allclose(found["b"], -np.diag(lengths), atol=1e-14)
    least = np.linalg.svd(legs / lengths[:, None])[1][-1]
    assert abs(found["sigma_a"] - least) < 1e-14
    code, text, _ = run("jacobian", "nam-2-rpr", "--pose=-500,1500", "--unit", "mm")
    assert code == 0 and "x -500, y 1500" in text and f"A {least:.6g}" in text and "status" not in text
    assert f"{lengths[0] * 1000:.9g}" in text
    numbers = [line.split() for line in text.splitlines() if line.startswith("   ")]
    np.testing.assert_allclose(np.array(numbers, float)[:2], legs, rtol=1e-6)


def test_jacobian_at_home(run):
    found = json.loads(run("jacobian", HEXAPOD, "--json")[1])
    assert found["unit"] == "mm" and 150 < found["joints"]["q1"] < 151
    a, b, j = (np.array(found[k]) for k in "abj")
    np.testing.assert_allclose(a @ j, -b, atol=1e-12)
    assert list(found["pose"]) == ["x", "y", "z", "qw", "qx", "qy", "qz", "rx", "ry", "rz"]


def test_jacobian_of_a_stretched_leg(run, here, five_bar):
    """A type I singularity: A and B are there, and said to be singular."""
    code, out, _ = run("jacobian", five_bar, "--pose", f"-50,{np.sqrt((139 + 269) ** 2 - 150**2)}", "--json")
    found = json.loads(out)
    assert code == 0 and found["status"] == "SINGULAR" and found["sigma_b"] < 1e-6


@pytest.mark.parametrize(
    ("name", "begin"), [("a b.png", b"\x89PNG"), ("ü.svg", b"<?xml"), ("c.PDF", b"%PDF")]
)
def test_draw(run, here, five_bar, name, begin):
    code, out, err = run("draw", five_bar, "--pose", "-20,220", "-o", name)
    assert (code, out, err) == (0, "", "") and (here / name).read_bytes().startswith(begin)
    assert sorted(os.listdir(here)) == sorted([name, five_bar])


def test_draw_in_space(run, here):
    code, _, err = run("draw", HEXAPOD, "-o", "h.svg")
    assert code == 0 and err == "" and "hexapod.toml" in (here / "h.svg").read_text()


def test_show(run, five_bar):
    code, out, _ = run("show", five_bar)
    assert code == 0 and out.startswith(five_bar) and "düne" in out
    for line in ("family FiveBar, lengths in mm", "half_base 100\n", "proximal 139\n", "length 100\n"):
        assert line in out
    assert "home pose: x 0, y " in out and "margin reach_min: " in out
    out = run("show", HEXAPOD)[1]
    assert "124.762" in out and "legendryflyer" in out and "unit" not in out
    out = run("show", "nam-2-rpr", "--unit", "mm")[1]
    assert "Nam, Lee and Park 2006" in out and "l_max 3000\n" in out and "y 1732.05081" in out


def test_singularity_of_a_pose(run, here):
    """A five-bar with its links in line is singular of type II; the screws are those of `pk.screws`."""
    code, out, _ = run("singularity", "5-link", "--pose", "0,0.35", "--mode", "+-", "--json")
    found, mech = json.loads(out), pk.catalogued("5-link")
    pose = np.array([0.0, 0.35])
    expected = pk.screws(mech, pose, mech.inverse(pose))
    assert code == 0 and found["kind"] == "REGULAR" and found["length"] == 0.1
    np.testing.assert_allclose(found["lines"], expected.lines, rtol=1e-12)
    np.testing.assert_allclose(found["arms"], expected.arms, rtol=1e-12)
    code, out, _ = run("singularity", "nam-2-rpr", "--pose", "0.5,0", "-o", "flat.png")
    assert code == 0 and "\nTYPE_II, " in out and "arm 1" in out
    assert Path("flat.png").read_bytes().startswith(b"\x89PNG")
    _, out, _ = run("singularity", "nam-2-rpr", "--pose", "0.5,0.01", "--tol", "0.1")
    assert "\nTYPE_II, " in out


def test_singularity_maps_a_workspace(run, here, five_bar):
    """Points of the file are singular; those of type I lie on circles of radius la + lb or lb - la."""
    arguments = ("singularity", five_bar, "--range", "x=-420:420", "--range", "y=-420:420", "--nodes", "31")
    code, out, _ = run(*arguments, "--kind", "I", "--csv", "points.csv", "-o", "map.svg")
    assert code == 0 and "TYPE_I" in out and "TYPE_II" not in out and "-420 .. 420 mm" in out
    assert "<svg" in Path("map.svg").read_text()
    header, *lines = Path("points.csv").read_text().splitlines()
    assert header == "curve,kind,x,y,q1,q2,mode,sigma"
    x, y, sigma = np.array([[line.split(",")[k] for k in (2, 3, 7)] for line in lines], float).T
    distances = np.abs([np.hypot(x - foot, y) for foot in (100, -100)])
    off = np.min(np.abs(np.subtract.outer(distances, [269 - 139, 269 + 139])), axis=(0, 2))
    assert len(x) > 100 and np.max(off) < 1e-6 and np.max(sigma) < 1e-9
    assert {line.split(",")[6] for line in lines} <= {a + b for a in "+-0" for b in "+-0"} - {
        "++",
        "--",
        "+-",
    }


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("nope",), "no mechanism 'nope'"),
        (("5-link", "--axes", "x,q"), "axes must be 2 to 3 different ones of x, y, got"),
        (
            ("3-rrr", "--axes", "x,y,phi"),
            "axes must be two here: the loci of PlanarRRR over 3 axes are no curves",
        ),
        (("5-link", "--range", "x=1"), "--range must be NAME=LOWER:UPPER, got 'x=1'"),
        (("5-link", "--range", "x=0:1"), "axes must be 2 to 3"),
        (("5-link", "--axes", "x,y", "--range", "x=0:1"), "--range must be given for each of --axes x,y"),
        (("5-link", "--range", "x=1:0", "--range", "y=0:1"), "lower < upper"),
        (("5-link", "--range", "z=1:0"), "--range must name one of x, y, got 'z'"),
        (("5-link", "--mode", "+"), "branch must have shape (2,), got (1,)"),
        (("5-link", "--mode", "+x"), "--mode must be signs, like +-+, got '+x'"),
        (("5-link", "--nodes", "2"), "nodes must be an integer from 3"),
        (("5-link", "--pose", "0,0.9"), "--pose 0,0.9 is UNREACHABLE"),
        (("5-link", "--pose", "0,0.3", "--tol", "2"), "tol must be in (0, 1), got 2"),
        (("5-link", "-o", "map.jpg"), "-o must end in .png, .svg or .pdf, got 'map.jpg'"),
        (("3-rrr", "--at", "0,0"), "--at"),
    ],
)
def test_singularity_tells_a_mistake_in_one_line(run, here, arguments, expected):
    code, out, err = run("singularity", *arguments)
    assert code == 2 and not out and err.count("\n") == 1 and expected in err
    assert not list(here.iterdir())
