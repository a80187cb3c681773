"""Forty bad inputs, by number: one clear line, no traceback, nothing half-written, from shell and Python.

Two of them are good: 20, a start that is the solution, and 36, spaces and letters of all kinds in a path.
"""

import contextlib
import io
import itertools
import json
import os
import re
import resource
import shlex
import signal
import struct
import sys
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
import small_runs
from refusals import said_by

import pk_jax as pk
from pk_jax import checks
from pk_jax.files import checkpoint, design_run, run_file
from pk_jax.files.run_folder import run_folder

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NAN, INF = np.nan, np.inf
HEXAPOD = Path(__file__).parent.parent / "examples" / "hexapod.toml"
ROBOT = 'family = "FiveBar"\nunit = "mm"\nhalf_base = 100\nproximal = 139\ndistal = 269\n'
LEGS = 'family = "TwoRPR"\nunit = "m"\nhalf_base = 1.0\nl_min = 1.0\nl_max = 3.0\n'
SIX = np.array([[np.cos(a), np.sin(a), 0] for a in (0.1, 1.9, 2.3, 4.0, 4.4, 6.1)])
CORNERS = 0.6 * np.array([[np.cos(a), np.sin(a), 0] for a in (0.9, 1.2, 3.0, 3.3, 5.1, 5.4)])
HEXAGON = np.array([[np.cos(a), np.sin(a), 0] for a in np.pi / 3 * np.arange(6)])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
BOX = ((-0.5, 0.5), (0.8, 1.6))
MANY = np.broadcast_to(np.zeros(2), (10**12, 2))


def two(**fields):
    return lambda: pk.TwoRPR(**{"half_base": 1.0, "l_min": 1.0, "l_max": 3.0, **fields})


def five(**fields):
    return pk.FiveBar(**{"half_base": 0.3, "proximal": 1.0, "distal": 1.5, **fields})


def stewart(**fields):
    return lambda: pk.Stewart(**{"base": SIX, "platform": CORNERS, **fields})


def arms(base):
    return lambda: pk.PlanarRRR(base=base, platform=0.2 * SIX[::2, :2], proximal=1.0, distal=1.0)


def problem(objective=lambda mech: mech.proximal, low=0.5, high=2.0):
    variables = {"proximal": (low, high), "distal": (1.0, 2.5)}
    return pk.DesignProblem(lambda values: five(**values), variables, objective)


def optimized(**options):
    return lambda: pk.optimize_design(problem(), **options)


def single():
    """A mechanism of another precision than the function wants."""
    return pk.FiveBar(half_base=np.float32(0.3), proximal=np.float32(1), distal=np.float32(1.5))


def integral(**options):
    return lambda: pk.workspace_integral(five(), **options)


def calibrated(joints):
    poses = np.array([[0.1 * k, 1.5] for k in range(8)])
    return pk.calibrate(five(), poses, np.asarray(joints))


PYTHON = [  # number, what is called, how it is refused
    (1, two(half_base=NAN), "TwoRPR.half_base must be finite, got nan"),
    (1, stewart(base=np.where(SIX[3, 0] == SIX, NAN, SIX)), "Stewart.base must be finite"),
    (2, two(l_max=INF), "TwoRPR.l_max must be finite, got inf"),
    (2, lambda: pk.travel(five(), "x", most=INF), "most must be positive and finite, got inf"),
    (3, two(half_base=0.0), "TwoRPR.half_base must be positive, got 0"),
    (3, lambda: five(distal=-1.5), "FiveBar.distal must be positive, got -1.5"),
    (4, two(l_min=3.0, l_max=1.0), "TwoRPR.l_max"),
    (4, stewart(stroke=(2.0, 0.5)), "Stewart.stroke must be 0 < least < greatest, got [2.0, 0.5]"),
    (5, stewart(base=SIX[:5], platform=CORNERS[:5]), "Stewart.base must have six rows"),
    (5, lambda: pk.forward_kinematics(five(), np.ones(5)), "joints must have shape (2,), got (5,)"),
    (5, lambda: pk.pose_jacobian(five(), [0.1, 1.5], [1.0, 2.0, 3.0]), "joints must have shape (2,), got (3"),
    (6, arms([[0, 0], [1, 0], [0]]), "PlanarRRR.base must be a number or a regular array"),
    (6, lambda: pk.inverse_kinematics(five(), [[0.1], [0.2, 0.3]]), "pose must be a number or a regular"),
    (7, lambda: pk.inverse_kinematics(five(), []), "pose must have shape (2,), got (0,)"),
    (7, lambda: pk.assembly_modes(five(), np.zeros((0, 2))), "joints must have at least one row, got none"),
    (7, lambda: pk.DesignProblem(lambda v: five(), {}, lambda m: m.proximal), "variables must be a dict"),
    (8, two(half_base="1.0"), "TwoRPR.half_base must be real numbers, got 1.0 (<U3)"),
    (8, two(half_base=True), "TwoRPR.half_base must be real numbers, got True (bool)"),
    (8, lambda: pk.inverse_kinematics(five(), [None, 1.0]), "pose must be real numbers, got [None 1.0]"),
    (8, lambda: pk.travel(five(), "x", steps=2.5), "steps must be an integer from 1 to 100000, got 2.5"),
    (8, lambda: pk.forward_kinematics(five(), [1.0, 2.0], certify="no"), "certify must be True or False"),
    (8, lambda: pk.evaluate_designs(problem(), [[1, 2]], slopes=0), "slopes must be True or False, got 0"),
    (8, lambda: pk.calibrate(five(), None, None, offsets=1), "offsets must be True or False, got 1"),
    (8, lambda: pk.stewart_from_log(None, np.ones((99, 6)), offsets=None), "offsets must be True or False"),
    (8, optimized(report=""), "report must be a function or None, got ''"),
    (8, lambda: pk.optimize_design(pk.design_space("2-rpr"), report=1), "report must be a function or None"),
    (8, lambda: pk.pareto_designs(pk.design_space("2-rpr"), report=1), "report must be a function or None"),
    (8, lambda: pk.pareto_problem(problem(), report=[]), "report must be a function or None, got []"),
    (8, lambda: pk.index_bounds("2-rpr"), "space must come from design_space(...), got str"),
    (8, lambda: pk.index_bounds(pk.design_space("2-rpr"), report=1), "report must be a function or None"),
    (8, lambda: pk.singularity_locus(five(), report=0), "report must be a function or None, got 0"),
    (8, lambda: pk.assembly_modes(five(), [1.0, 2.0], report={}), "report must be a function or None, got"),
    (8, lambda: pk.connect_modes(five(), [1.0, 2.0], None, report=1), "report must be a function or None"),
    (8, lambda: pk.connect_modes(five(), [1.0, 2.0], None, within_limits=1), "within_limits must be True or"),
    (8, lambda: pk.certify_regular(five(), {}, report=0), "report must be a function or None, got 0"),
    (8, lambda: pk.certify_confined(five(), {}, report=0), "report must be a function or None, got 0"),
    (8, lambda: pk.place_sensors(stewart()(), 0, radius=1.0, report=0), "report must be a function or None"),
    (9, two(half_base=1j), "TwoRPR.half_base must be real numbers, got 1j (complex128)"),
    (9, lambda: pk.screws(five(), [0.1, 1.5], [1j, 2]), "joints must be real numbers"),
    (10, lambda: pk.certify(single(), [0.1, 1.5], [1.0, 2.0]), "certify needs float64: call pk_jax.enable_x"),
    (10, lambda: pk.singularity_locus(single()), "singularity_locus needs float64: call pk_jax.enable_x64()"),
    (11, arms([[0, 0], [1, 0], [1, 0]]), "PlanarRRR.base must hold distinct joints, got [1.0, 0.0] in rows"),
    (11, stewart(base=SIX[[0, 0, 2, 3, 4, 5]], platform=CORNERS[[0, 0, 2, 3, 4, 5]]), "the same leg twice"),
    (12, stewart(base=SIX * [1, 0, 0]), "Stewart.base must not have all six joints on one line"),
    (12, stewart(platform=CORNERS * [0, 1, 0]), "Stewart.platform must not have all six joints on one line"),
    (13, stewart(base=HEXAGON, platform=0.5 * HEXAGON), "singular"),
    (14, two(l_min=3.0, l_max=3.0), "TwoRPR.l_max"),
    (14, lambda: pk.workspace_map(five(), ranges=((0, 0), (1, 2))), "ranges must be (lower, upper) with low"),
    (14, lambda: pk.workspace_map(five(), ranges=BOX, nodes=0), "nodes must be an integer from 2 to 100001,"),
    (14, integral(rule="panels", nodes=0), "nodes must be an integer from 2 to 64, got 0"),
    (15, lambda: pk.SE3(np.zeros(3), 2 * np.eye(3)), "SE3.rotation must be orthonormal"),
    (15, lambda: pk.AxisPose(0.1, TURN + 1e-3), "AxisPose.rotation must be orthonormal"),
    (16, lambda: pk.SE3.from_quaternion(np.zeros(3), np.zeros(4)), "quaternion must not be zero"),
    (17, lambda: pk.SE3(np.zeros(3), np.diag([1.0, 1, -1])), "SE3.rotation is a reflection: det = -1"),
    (21, lambda: pk.nine_length_pose(stewart()(), np.ones(9)), "takes a Stewart with nine rows"),
    (21, lambda: calibrated(np.zeros((8, 3))), "joints must have shape (any, 2), got (8, 3)"),
    (23, stewart(base_cone=20.0), "Stewart.base_cone must be in (0, pi] rad, got 20"),
    (24, lambda: pk.optimize_design(pk.design_space("2-rpr"), (0, 0, 0)), "weights must be >= 0 and not all"),
    (24, lambda: pk.pareto_problem(problem(), [[0.0]]), "weights must be >= 0, no row all zero"),
    (25, lambda: pk.composite_index([0.5] * 3, ([0] * 3, [1] * 3), (1, -1, 1)), "weights must be >= 0"),
    (25, lambda: pk.optimize_design(pk.design_space("2-rpr"), (1, NAN, 1)), "weights must be finite"),
    (25, lambda: pk.pose_covariance(stewart()(), None, np.zeros(6)), "pose must be a pk_jax.SE3, got NoneTy"),
    (26, optimized(starts=[[9.0, 1.5]]), "starts must lie within the bounds, proximal in [0.5, 2], got 9"),
    (26, lambda: pk.optimize_design(pk.design_space("2-rpr"), starts=[[7.0]]), "starts lies outside the 2-r"),
    (27, lambda: problem(low=2.0, high=0.5), "variables['proximal'] must have lower < upper"),
    (27, integral(within={"x": (1, 0)}), "within['x'] must be (least, greatest), got (1, 0)"),
    (27, lambda: pk.rectangle([1.0], [0.0], 3), "lower must be at most upper, got [1.0] and [0.0]"),
    (28, lambda: pk.pareto_designs(pk.design_space("2-rpr"), steps=None), "steps must be an integer from 1"),
    (28, optimized(steps=0), "steps must be an integer from 1 to 100000, got 0"),
    (28, optimized(steps=-3), "steps must be an integer from 1 to 100000, got -3"),
    (28, optimized(steps=1e24), "steps must be an integer from 1 to 100000, got 1e+24"),
    (28, optimized(steps=10**24), f"steps must be an integer from 1 to 100000, got {10**24}"),
    (29, optimized(tolerance=0.0), "tolerance must be a number between 0 and 1, got 0.0"),
    (29, optimized(tolerance=NAN), "tolerance must be a number between 0 and 1, got nan"),
    (31, lambda: pk.workspace_integral(five(), "isotropi"), "index must be a function or one of frobenius_i"),
    (31, lambda: pk.integral_gradient(lambda v: five(), [1.0], {}), "index must be a function or one of fro"),
    (31, lambda: pk.workspace_map(five(), "x,q"), "axes must be 2 to 3 different ones of x, y, got ('x', 'q"),
    (31, lambda: pk.load_mechanism(""), "path must be the name of a file, got ''"),
    (31, lambda: pk.load_mechanism(None), "path must be the name of a file, got None"),
    (31, lambda: pk.save_mechanism(five(), ""), "path must be the name of a file, got ''"),
    (31, lambda: pk.catalogued("3-rrrr"), "no catalogue entry '3-rrrr'; there are nam-2-rpr"),
]  # fmt: skip

FILES = {
    "robot.toml": ROBOT,
    "legs.toml": LEGS,
    "nan.toml": ROBOT.replace("139", "nan"),
    "inf.toml": ROBOT.replace("139", "inf"),
    "zero.toml": ROBOT.replace("139", "0.0"),
    "strokes.toml": LEGS.replace("3.0", "0.5"),
    "five.toml": HEXAPOD.read_text().replace("    [124.762, 32.11, 39.656],\n", "", 1),
    "ragged.toml": HEXAPOD.read_text().replace("[124.762, 32.11, 39.656]", "[124.762, 32.11]"),
    "empty.toml": "",
    "empty.csv": "",
    "string.toml": ROBOT.replace("139", '"139"'),
    "bool.toml": ROBOT.replace("139", "true"),
    "rows.csv": "2,2\n2.1,2.2\n",
    "three.csv": "1,2,3\n",
    "complex.csv": "2,1j\n",
    "mm.csv": "l1_mm,l2_mm\n2000,2000\n",
    "long.csv": "2000,9000\n",
    "degrees.csv": "q1_deg,q2_deg\n20,120\n",
    "degrees.toml": HEXAPOD.read_text() + "base_cone = 20.0\n",
    "missing.toml": ROBOT.replace("distal = 269\n", ""),
    "unknown.toml": ROBOT + "colour = 3\n",
    "misspelt.toml": ROBOT.replace("proximal", "proksimal"),
    "broken.toml": ROBOT + "distal",
    "twice.toml": ROBOT + "distal = 300\n",
    "latin.toml": b'family = "\xff"',
    "huge.toml": ROBOT + "#" * 6_000_000,
    "bom.toml": "\ufeff" + ROBOT,
    "run.toml": small_runs.TEXT,
    "bounds.toml": small_runs.TEXT.replace("[0.5, 2.0]", "[2.0, 0.5]"),
    "steps.toml": small_runs.TEXT.replace("steps = 60", "steps = 1000000000000000000000000"),
    "rate.toml": small_runs.TEXT + "tolerance = nan\n",
    "nodes.toml": small_runs.TEXT.replace("[3, 3]", "[1000000, 1000000]"),
    "starts.toml": small_runs.TEXT.replace("starts = 7", "starts = 1000000000000"),
    "keys.toml": small_runs.TEXT.replace("starts", "strats"),
}

COMMANDS = [  # number, arguments, exit code, what is said
    (1, "show nan.toml", 2, "nan.toml: proximal must be finite, got nan"),
    (1, "workspace 2-rpr --l-min nan", 2, "TwoRPR.l_min must be finite, got nan"),
    (2, "show inf.toml", 2, "inf.toml: proximal must be finite, got inf"),
    (3, "check zero.toml", 2, "zero.toml: FiveBar.proximal must be positive, got 0"),
    (3, "workspace 2-rpr --l-min -1", 2, "TwoRPR.l_min must be positive, got -1"),
    (4, "show strokes.toml", 2, "strokes.toml: TwoRPR.l_max"),
    (5, "show five.toml", 2, "five.toml: Stewart.base must have six rows (legs) or more (sensors), got 5"),
    (5, "fk robot.toml three.csv", 2, "three.csv:1: there must be 2 (q1,q2) columns, got 3"),
    (6, "show ragged.toml", 2, "ragged.toml: base must have rows of one length"),
    (7, "check empty.toml", 2, "empty.toml: missing key 'family'"),
    (7, "fk legs.toml empty.csv", 2, "empty.csv: there are no rows of numbers"),
    (8, "show string.toml", 2, "proximal must be a number or an array of numbers, got '139'"),
    (8, "show bool.toml", 2, "proximal must be a number or an array of numbers, got True"),
    (9, "fk legs.toml complex.csv", 2, "complex.csv:1: field 2 must be a number, got '1j'"),
    (14, "map robot.toml --nodes 0", 2, "nodes must be an integer from 2 to 100001, got 0"),
    (14, "map robot.toml --range x=1:1 --range y=0:1", 2, "ranges must be (lower, upper) with lower < upper"),
    (18, "draw robot.toml --pose 0,5000 -o a.png", 2, "--pose 0,5000 is UNREACHABLE: there are no joints fo"),
    (22, "fk legs.toml mm.csv", 2, "mm.csv:1: column 'l1_mm' is in mm, but what is read are lengths in m"),
    (23, "fk robot.toml degrees.csv", 2, "column 'q1_deg' is in deg, but what is read are angles in rad"),
    (23, "show degrees.toml", 2, "base_cone must be at most pi, got 20.0: radians, not degrees?"),
    (24, "optimize 2-rpr --weights 0 0 0", 2, "weights must be >= 0 and not all zero"),
    (25, "optimize 2-rpr --weights 1 -1 1", 2, "weights must be >= 0"),
    (25, "optimize 2-rpr --weights 1 nan 1", 2, "weights must be finite"),
    (27, "check bounds.toml", 2, "variables.proximal must be [lower, upper] with lower < upper"),
    (27, "map robot.toml --range x=1:0 --range y=0:1", 2, "lower < upper"),
    (28, "optimize 2-rpr --steps 0", 2, "steps must be an integer from 1 to 100000, got 0"),
    (28, "optimize steps.toml --out a", 2, "search.steps must be an integer from 1 to 100000, got 1000000"),
    (29, "optimize rate.toml --out a", 2, "search.tolerance must be finite, got nan"),
    (29, "simulate nine-lengths --gain kp=nan", 2, "gains.kp must be finite, got nan"),
    (31, "check missing.toml", 2, "missing key 'distal'; a FiveBar needs half_base, proximal, distal"),
    (31, "check unknown.toml", 2, "unknown.toml: unknown key 'colour'"),
    (31, "check misspelt.toml", 2, "unknown key 'proksimal' (did you mean 'proximal'?)"),
    (31, "optimize keys.toml --out a", 2, "unknown key 'search.strats' (did you mean 'starts'?)"),
    (31, "fk robot.toml rows.csv --colums 1,2", 2, "unrecognized arguments: --colums"),
    (32, "check broken.toml", 2, "broken.toml: invalid TOML: "),
    (32, "check twice.toml", 2, "twice.toml: invalid TOML: Cannot overwrite a value"),
    (32, "check latin.toml", 2, "latin.toml: a mechanism file must be UTF-8 text, invalid start byte at byt"),
    (32, "check huge.toml", 2, "huge.toml: a mechanism file must have at most 5000000 bytes, this one has m"),
    (35, "show ../none.toml", 4, "No such file or directory: ../none.toml"),
    (35, "show a/b/c", 2, "no mechanism 'a/b/c' in the catalogue, and no such file"),
    (35, "optimize run.toml --out robot.toml", 4, "File exists: robot.toml"),
    (37, "fk legs.toml rows.csv -o robot.toml/a.csv", 4, "robot.toml/a.csv"),
    (37, "fk legs.toml rows.csv -o /proc/a.csv", 4, "/proc/a.csv"),
    (37, "draw robot.toml -o /proc/a.png", 4, "/proc/a.png"),
    (37, "map legs.toml --nodes 5 --csv /proc/a.csv", 4, "/proc/a.csv"),
    (37, "optimize run.toml --out /proc/a", 4, "/proc/a"),
    (37, "reproduce --out robot.toml/a", 4, "robot.toml/a"),
    (40, "map robot.toml --nodes 1000000000000", 2, "nodes must be an integer from 2 to 100001, got 1000000"),
    (40, "map robot.toml --nodes 1e24", 2, "argument --nodes: invalid int value: '1e24'"),
    (40, "singularity robot.toml --nodes 1000000", 2, "nodes must be an integer from 3 to 2001, got 1000000"),
    (40, "workspace legs.toml --nodes 1000000 8", 2, "nodes must be an integer from 2 to 512, got 1000000"),
    (40, "workspace robot.toml --index isotropy --rays 1000000000000", 2, "rays must be an integer from 8 t"),
    (40, "certify casing-oscillator --range s=0.47:0.48 --most 1000000000000", 2, "most must be an integer"),
    (40, "optimize 2-rpr --starts 1000000000000", 2, "starts must be an integer from 1 to 10000"),
    (40, "optimize starts.toml --out a", 2, "search.starts must be an integer from 1 to 100000"),
    (40, "optimize nodes.toml --out a", 2, "objective.nodes must be an integer from 1 to 100000, got 100000"),
    (40, "optimize run.toml --out a --shard 1/999999", 2, "7 starts make at most 7 parts, got 999999"),
    (40, "optimize run.toml --out a --devices 1000000", 2, "--devices must be from 1 to 4096, got 1000000"),
    (40, "fk legs.toml rows.csv --chunk 1000000000000", 2, "--chunk must be at most 10000000"),
    (40, "simulate nine-lengths --seeds 1000000000000", 2, "seeds must be an integer from 1 to 100000"),
    (40, "simulate nine-lengths --seed -1 --seeds 1", 2, "seed must be an integer from 0 to 4294967295, got"),
    (40, "sensors nine-lengths --place 1 --starts 1000000000000", 2, "starts must be an integer from 1 to 1"),
]  # fmt: skip


@pytest.fixture
def small(monkeypatch):
    """Design runs that compile at once."""
    monkeypatch.setattr(run_file, "problem_of", small_runs.small_problem)
    monkeypatch.setattr("pk_jax.cli.design._figures", lambda run: None)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with all files above, which is the working directory."""
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names_in(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def ids_of(table):
    """The number, and which of its rows it is."""
    numbers = [row[0] for row in table]
    return [f"{number}-{numbers[:k].count(number) + 1}" for k, number in enumerate(numbers)]


@pytest.mark.parametrize(("number", "call", "expected"), PYTHON, ids=ids_of(PYTHON))
def test_from_python(number, call, expected):
    said = said_by(call)
    assert expected in said and len(said) < 400


@pytest.mark.parametrize(("number", "command", "code", "expected"), COMMANDS, ids=ids_of(COMMANDS))
def test_from_the_shell(run, here, small, number, command, code, expected):
    before = names_in(here)
    found, out, err = run(*shlex.split(command))
    told = [line for line in err.splitlines() if line.startswith("pk-jax")]
    assert found == code and out == "" and expected in err, err
    assert len(told) == 1 and len(told[0]) < 450
    assert names_in(here) == before


# --- what is told by a status, not by an error


def test_18_a_pose_out_of_reach():
    found = pk.inverse_kinematics(five(), [[0.1, 1.5], [0.0, 9.0]])
    assert [pk.Status(each) for each in found.status] == [pk.Status.OK, pk.Status.UNREACHABLE]
    assert np.array_equal(np.isfinite(found.joints).all(axis=1), [True, False])


def test_18_rows_that_are_not_ok_are_told_by_the_exit_code(run, here):
    (here / "far.csv").write_text("0,200\n0,5000\n")
    code, out, err = run("ik", "robot.toml", "far.csv", "--strict")
    assert code == 3 and out.splitlines()[2] == "nan,nan,UNREACHABLE" and "1 OK, 1 UNREACHABLE" in err


def test_19_a_singular_start_is_never_a_wrong_answer():
    """Both elbows on one line with the end point: a type II singularity."""
    mech = five(half_base=0.5, proximal=0.5, distal=1.0)
    joints = pk.inverse_kinematics(mech, [0.2, 1.0]).joints
    level = [0.0, 0.0]  # the distal links lie on the x axis where the arms do
    found = pk.forward_kinematics(mech, joints, guess=level)
    residual = np.max(np.abs(mech.residual(found.candidate, joints)))
    assert np.isfinite(found.pose).all() == (found.status == pk.Status.OK)
    assert found.status != pk.Status.OK or residual < 1e-12
    path = pk.track(mech, [[0.0, np.pi], [0.0, np.pi]], start=level)
    assert path.reached == 0 and np.isnan(path.pose).all()


def test_20_a_start_that_is_the_solution():
    mech = five()
    joints = pk.inverse_kinematics(mech, [0.1, 1.5]).joints
    found = pk.forward_kinematics(mech, joints, guess=[0.1, 1.5])
    assert found.status == pk.Status.OK
    np.testing.assert_allclose(found.pose, [0.1, 1.5], atol=1e-15)


@pytest.mark.soak
def test_20_a_search_that_starts_at_the_best_design():
    top = pk.DesignProblem(lambda v: five(**v), {"proximal": (0.5, 2)}, lambda m: -((m.proximal - 1) ** 2))
    best = pk.optimize_design(top, starts=[[1.0]])
    assert best.status == pk.Status.OK and best.vector == [1.0]


@pytest.mark.soak
def test_21_sensors_that_contradict_the_legs():
    mech = pk.catalogued("nine-lengths")
    lengths = np.array(mech.home()[1])
    lengths[8] *= 1.5
    found = pk.nine_length_pose(mech, lengths)
    assert found.status == pk.Status.INCONSISTENT and np.isnan(found.pose.translation).all()


def test_22_millimetres_for_metres():
    with pytest.warns(UserWarning, match="are they in one unit"):
        found = pk.inverse_kinematics(five(), [100.0, 1500.0])
    assert found.status == pk.Status.UNREACHABLE


@pytest.mark.filterwarnings("default")
def test_22_millimetres_for_metres_in_a_file(run, here):
    code, _, err = run("fk", "legs.toml", "long.csv", "-o", "a.csv")
    told = [line for line in err.splitlines() if line.startswith("pk-jax: warning: ")]
    assert code == 0 and len(told) == 1 and told[0].endswith("are they in one unit?")


def test_30_an_objective_that_is_no_number():
    found = pk.optimize_design(problem(lambda mech: mech.proximal * NAN), starts=2, steps=3)
    assert found.status == pk.Status.NONFINITE and np.isnan(found.value)


@pytest.mark.soak
def test_30_an_objective_that_is_no_number_in_a_run(run, here, small, monkeypatch):
    nothing = problem(lambda mech: mech.proximal * NAN)
    monkeypatch.setattr(run_file, "problem_of", lambda settings: nothing)
    code, out, _ = run("optimize", "run.toml", "--out", "a", "--quiet")
    assert code == 5 and "NONFINITE" in out and not (here / "a" / "result.toml").exists()
    assert json.loads((here / "a" / "result.json").read_text())["value"] is None


@pytest.mark.parametrize("build", [five, lambda **fields: pk.TwoRPR(half_base=1.0, l_min=1.0, **fields)])
def test_31_a_misspelt_field(build):
    with pytest.raises(TypeError, match="lenght"):
        build(lenght=1.0)


def test_32_a_byte_order_mark_is_harmless(run, here):
    assert run("show", "bom.toml")[0] == run("show", "robot.toml")[0] == 0


# --- checkpoints and parts


def packed(names=("a.npy", "header.npy"), text=None, **arrays):
    """The bytes of a file of arrays, with a header that promises them."""
    promised = {name: [array.dtype.str, list(array.shape)] for name, array in arrays.items()}
    header = text or json.dumps({"format": 1, "arrays": promised})
    file = io.BytesIO()
    np.savez(file, header=np.frombuffer(header.encode(), np.uint8), **arrays)
    return file.getvalue()


def promising(shape):
    """An array of eight bytes whose header promises more."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": "<f8"})
    file = io.BytesIO(packed(text=json.dumps({"format": 1, "arrays": {"a": ["<f8", list(shape)]}})))
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("a.npy", stream.getvalue() + b"12345678")
    return file.getvalue()


def deflated():
    """A gigabyte of zeros in a file of a megabyte."""
    file = io.BytesIO(packed())
    with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(64):
            member.write(bytes(2**20))
    return file.getvalue()


def overlapping(count=1000):
    """A zip whose directory names the same bytes a thousand times."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("header.npy", bytes(100))
        for number in range(count):
            archive.writestr(f"{number:04}.npy", b"")
    content = bytearray(file.getvalue())
    at = content.index(b"PK\1\2")
    while (at := content.find(b"PK\1\2", at + 4)) > 0:
        content[at + 20 : at + 28] = struct.pack("<II", 100, 100)  # sizes
        content[at + 42 : at + 46] = bytes(4)  # where it begins: at the first member
    return bytes(content)


class Code:
    """Pickled, it would make a folder when it is read."""

    def __reduce__(self):
        return os.mkdir, ("seen",)


DAMAGED = {
    "truncated": (lambda whole: whole[:-100], "not a zip file"),
    "flipped": (lambda whole: whole.replace(b"NUMPY", b"NUMBY", 1), ""),
    "pickled": (lambda whole: packed(a=np.array([Code()], object)), "must be numbers"),
    "no zip": (lambda whole: b"checkpoint", "not a zip file"),
    "deflated": (lambda whole: deflated(), "larger than the file"),
    "overlapping": (lambda whole: overlapping(), "larger than the file"),
    "1e12 numbers": (lambda whole: promising((10**12,)), "not as long as its shape"),
    "negative shape": (lambda whole: promising((-1,)), ""),
}


@pytest.fixture
def interrupted(here, small):
    """A run of which there is a checkpoint."""
    run = run_file.read_run("run.toml")
    with pytest.raises(KeyboardInterrupt):
        design_run.run_into("a", run, further=small_runs.stopping(run, 1))
    return here / "a" / "checkpoint.npz"


@pytest.mark.parametrize("how", DAMAGED)
def test_33_a_damaged_checkpoint_or_part(run, interrupted, how):
    damage, expected = DAMAGED[how]
    content = damage(interrupted.read_bytes())
    interrupted.write_bytes(content)
    (interrupted.parent / "part-1-of-1.npz").write_bytes(content)
    code, out, err = run("merge", "a")
    assert code == 2 and out == "" and err.count("\n") == 1 and expected in err
    (interrupted.parent / "part-1-of-1.npz").unlink()
    before = names_in(interrupted.parent)
    code, out, err = run("optimize", "run.toml", "--out", "a", "--resume")
    assert code == 2 and out == "" and err.count("\n") == 1 and expected in err
    assert err.startswith("pk-jax: a/checkpoint.npz: no checkpoint, or a damaged one: ")
    assert interrupted.read_bytes() == content and names_in(interrupted.parent) == before
    assert not Path("seen").exists()


def test_34_a_checkpoint_of_another_run(run, interrupted):
    before = interrupted.read_bytes()
    Path("run.toml").write_text(small_runs.TEXT.replace("[0.5, 2.0]", "[0.5, 1.9]"))
    code, out, err = run("optimize", "run.toml", "--out", "a", "--resume")
    assert code == 2 and out == "" and "a holds another run: variables.proximal = [0.5, 2.0] there" in err
    header, arrays = checkpoint.read_saved(interrupted)
    Path("run.toml").write_text(small_runs.TEXT)
    interrupted.write_bytes(checkpoint.packed({**header, "config": "0" * 64}, arrays))
    code, out, err = run("optimize", "run.toml", "--out", "a", "--resume")
    assert code == 2 and out == "" and "a/checkpoint.npz is of another run: its config is '000" in err
    interrupted.write_bytes(before)
    assert run("optimize", "run.toml", "--out", "a", "--resume", "--quiet")[0] == 0


# --- paths, disks, processes


@pytest.mark.parametrize(
    "arguments",
    [
        ["show", "a\0b.toml"],
        ["fk", "legs.toml", "a\0b.csv"],
        ["fk", "legs.toml", "rows.csv", "-o", "a\0b.csv"],
        ["optimize", "run.toml", "--out", "a\0b"],
        ["merge", "a\0b"],
        ["reproduce", "--out", "a\0b"],
    ],
    ids=lambda arguments: "-".join(arguments[::3]).replace("\0", "0"),
)
def test_35_a_path_with_a_null(run, here, small, arguments):
    before = names_in(here)
    code, out, err = run(*arguments)
    assert code == 2 and out == "" and len(err.splitlines()) == 1 and err.startswith("pk-jax: ")
    assert "a\\x00b" in err and names_in(here) == before


def test_35_a_link_in_a_run_folder_does_not_lead_out(run, here, small):
    (here / "a").mkdir()
    (here / "precious").write_text("mine")
    (here / "a" / "starts.csv").symlink_to(here / "precious")
    assert run("optimize", "run.toml", "--out", "a", "--quiet")[0] == 0
    assert (here / "precious").read_text() == "mine" and not (here / "a" / "starts.csv").is_symlink()


@pytest.mark.parametrize("name", ["CON", "..", "-", "~no such user/b"])
def test_35_names_that_other_systems_know(run, here, small, name):
    """Here they are names like others, and none of them is guessed at."""
    (here / "b").mkdir()
    os.chdir(here / "b")
    code = run("fk", "../legs.toml", "../rows.csv", "-o", name)[0]
    assert code == {"CON": 0, "..": 4, "-": 0, "~no such user/b": 4}[name]
    assert names_in(here / "b") == (["CON"] if name == "CON" else [])
    os.chdir(here)


@pytest.fixture
def elsewhere(here, monkeypatch):
    """The same files in a folder with spaces and letters of all kinds."""
    folder = here / "ein Ordner ü" / "名前 ₂"
    folder.mkdir(parents=True)
    for name in ("robot.toml", "legs.toml", "rows.csv", "run.toml"):
        (folder / f"é {name}").write_bytes((here / name).read_bytes())
    (folder / "é log.csv").write_bytes(HEXAPOD.with_name("hexapod_log.csv").read_bytes())
    pk.save_mechanism(pk.catalogued("nine-lengths"), folder / "é nine.toml")
    pk.save_mechanism(pk.CasingOscillator(), folder / "é casing.toml")
    monkeypatch.chdir(here)
    return "ein Ordner ü/名前 ₂/é "


ANYWHERE = [  # @: the folder
    "show '@robot.toml'",
    "check '@run.toml'",
    "fk '@legs.toml' '@rows.csv' -o '@2.csv'",
    "ik '@legs.toml' '@rows.csv' -o '@3.csv'",
    "optimize '@run.toml' --out '@7' --quiet --shard 1/1",
    "merge '@7'",
]
SLOWLY = [
    "draw '@robot.toml' -o '@1.png'",
    "jacobian '@legs.toml'",
    "modes '@legs.toml' --rows '@rows.csv' -o '@4.csv'",
    "map '@legs.toml' --nodes 5 --csv '@5.csv' -o '@6.png'",
    "check '@robot.toml'",
    "modes '@legs.toml' --figure '@8.png'",
    "singularity '@legs.toml' --csv '@9.csv' -o '@10.png' --nodes 21",
    "certify '@casing.toml' --range s=0.47:0.48",
    "workspace '@legs.toml'",
    "workspace '@legs.toml' --index isotropy",
    "calibrate '@log.csv' --unit mm -o '@11.toml'",
    "simulate '@nine.toml' --seeds 1 --duration 1.2 --csv '@12.csv' -o '@13.png'",
    "sensors '@nine.toml' --place 1 --starts 1 -o '@14.toml'",
    "reproduce --out '@15'",
    "reproduce planar-screws --out '@16'",
    "reproduce casing-oscillator --out '@17'",
    "reproduce nine-lengths --out '@18'",
]


def works(run, elsewhere, command):
    arguments = shlex.split(command.replace("@", elsewhere))
    code, out, err = run(*arguments)
    assert code == 0, err
    outputs = [path for option, path in itertools.pairwise(arguments) if option in ("-o", "--out", "--csv")]
    assert all(Path(path).exists() for path in outputs)
    return out


def test_36_spaces_and_letters_in_a_path(run, elsewhere, small):
    for command in ANYWHERE:
        works(run, elsewhere, command)


@pytest.mark.soak
@pytest.mark.parametrize("command", SLOWLY, ids=lambda command: command.split()[0])
def test_36_spaces_and_letters_in_the_paths_of_slow_verbs(run, elsewhere, command):
    works(run, elsewhere, command)


@contextlib.contextmanager
def no_room():
    """No file may become larger than a few bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    "command",
    ["fk legs.toml rows.csv -o old", "draw legs.toml -o old.png", "map legs.toml --nodes 5 --csv old"],
    ids=lambda command: command.split()[0],
)
def test_38_no_room_for_a_file(run, here, command):
    for name in ("old", "old.png"):
        (here / name).write_text("old")
    before = names_in(here)
    with no_room():
        code, _, err = run(*shlex.split(command))
    assert code == 4 and "File too large" in err.splitlines()[-1]
    assert names_in(here) == before and (here / "old").read_text() == (here / "old.png").read_text() == "old"


def test_38_no_room_for_a_run(run, here, small):
    before = names_in(here)
    with no_room():
        code, out, err = run("optimize", "run.toml", "--out", "a", "--quiet")
    assert code == 4 and out == "" and len(err.splitlines()) == 1 and "File too large" in err
    assert names_in(here) == before


def test_38_no_room_for_the_next_checkpoint(run, interrupted):
    before = interrupted.read_bytes(), names_in(interrupted.parent)
    with no_room():
        code, out, err = run("optimize", "run.toml", "--out", "a", "--resume", "--quiet")
    assert code == 4 and out == "" and "File too large" in err
    assert (interrupted.read_bytes(), names_in(interrupted.parent)) == before


def test_38_a_full_device(run, here):
    (here / "full.png").symlink_to("/dev/full")
    for command in ("fk legs.toml rows.csv -o /dev/full", "draw legs.toml -o full.png"):
        code, out, err = run(*shlex.split(command))
        assert code == 4 and out == "" and len(err.splitlines()) == 1 and "No space left on device" in err


def test_38_no_room_for_what_is_printed(run, monkeypatch):
    with contextlib.suppress(OSError), open("/dev/full", "w") as full:  # closing it, too, finds no room
        monkeypatch.setattr(sys, "stdout", full)
        code, _, err = run("list")
    assert code == 4 and err == "pk-jax: No space left on device\n"


def test_39_two_runs_in_one_folder(run, here, small):
    with run_folder("a") as folder:
        folder.write_text("mine", "")
        code, out, err = run("optimize", "run.toml", "--out", "a", "--quiet")
        assert code == 4 and out == "" and err == "pk-jax: a is being written by another process\n"
    assert names_in(here / "a") == ["mine"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_39_a_run_that_is_stopped_goes_on(run, here, small, monkeypatch, number):
    def on_devices(mine, devices):
        return small_runs.stopping(mine, 1, stop=lambda: signal.raise_signal(number), on_devices=on)

    on = design_run.on_devices
    monkeypatch.setattr(design_run, "on_devices", on_devices)
    code, out, err = run("optimize", "run.toml", "--out", "a", "--quiet")
    assert code == 130 and out == "" and err.startswith("pk-jax: interrupted; go on with: pk-jax optimize")
    assert not list(Path("a").glob(".*"))
    monkeypatch.setattr(design_run, "on_devices", on)
    assert run("optimize", "run.toml", "--out", "a", "--quiet")[0] == 2
    assert run("optimize", "run.toml", "--out", "a", "--quiet", "--resume")[0] == 0


def test_39_what_a_killed_run_leaves_is_no_obstacle(run, interrupted):
    """SIGKILL leaves the lock and a part of a file; see test_design_runs for processes that are killed."""
    for name in (".lock", ".checkpoint.npz.xyz.part"):
        (interrupted.parent / name).write_text("")
    assert run("optimize", "run.toml", "--out", "a", "--quiet", "--resume")[0] == 0
    assert not list(Path("a").glob(".*"))


# --- sizes


def rows(n):
    return np.broadcast_to(np.ones(2), (n, 2))


def of_loop(n):
    mech = pk.catalogued("nine-lengths")
    reference = pk.step_reference(mech, 0.01 * np.ones(6))
    return pk.simulate_control(mech, reference, key=jax.random.key(0), seeds=n)


SPACE = pk.design_space("2-rpr")
SIZES = {  # a function of a size, and what is too much for 200 kB; None: larger ones are refused
    "rows of joints": (lambda n: pk.forward_kinematics(five(), rows(n)), 10**5),
    "rows of poses": (lambda n: pk.local_indices(five(), rows(n)), 10**5),
    "poses in space": (lambda n: pk.SE3(np.broadcast_to(np.zeros(3), (n, 3)), TURN), 10**5),
    "nodes of a map": (lambda n: pk.workspace_map(five(), ranges=BOX, nodes=n), 201),
    "nodes of a locus": (lambda n: pk.singularity_locus(five(), ranges=BOX, nodes=n), 101),
    "nodes of strokes": (lambda n: pk.workspace_integral(two()(), rule="strokes", nodes=n), 64),
    "rays": (lambda n: pk.workspace_integral(five(), rule="rays", rays=n), 10**4),
    "replicates": (lambda n: pk.workspace_integral(five(), rule="rays", replicates=n), 16),
    "nodes of indices": (lambda n: pk.workspace_indices(two()(), nodes=(n, n)), None),
    "steps of a travel": (lambda n: pk.travel(five(), "x", steps=n), None),
    "boxes": (lambda n: pk.certify_regular(pk.CasingOscillator(), {"s": (0.47, 0.48)}, most=n), None),
    "nodes of roads": (lambda n: pk.connect_modes(five(), [1.0, 2.0], None, nodes=n), 100),
    "grid": (lambda n: pk.rectangle([0, 0], [1, 1], n), 200),
    "starts": (lambda n: pk.optimize_design(problem(), starts=n), 10**4),
    "steps": (lambda n: pk.optimize_design(SPACE, bounds=([0] * 3, [1] * 3), steps=n), 10**5),
    "weights": (lambda n: pk.pareto_problem(problem(), n), 10**4),
    "samples": (lambda n: pk.robust(problem(), {"proximal": 0.1}, samples=n), 10**4),
    "designs": (lambda n: pk.evaluate_designs(problem(), rows(n)), 10**5),
    "starts of sensors": (
        lambda n: pk.place_sensors(stewart()(), pk.SE3(np.zeros(3), TURN), radius=1.0, starts=n),
        10**3,
    ),
    "seeds": (of_loop, 10**3),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.soak) if name == "seeds" else name for name in SIZES]
)
def test_40_more_than_memory_holds(name, monkeypatch):
    call, many = SIZES[name]
    for size in (10**12, 10**24):
        if size == 10**12 or ("rows" not in name and name not in ("designs", "poses in space")):
            assert re.search("must be an integer|of memory, there are", said_by(call, size))
    if many is not None:
        monkeypatch.setattr(checks, "_memory", lambda: 2e5)
        assert re.search(r"would take \S+ GB of memory, there are 0.0002: take ", said_by(call, many))


def test_40_the_memory_of_a_machine():
    """That of this one is known, and less than the address space."""
    assert 2**27 < checks._memory() < 2**57


def test_40_the_command_line_tells_when_memory_runs_out(run, here, monkeypatch):
    def greedy(*_):
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr("pk_jax.files.shown.describe", greedy)
    code, out, err = run("show", "robot.toml")
    assert code == 2 and out == "" and "not enough memory, ask for less: Unable to allocate 9 TiB\n" in err


# --- keys, seeds, and arguments in each other's place


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: pk.inverse_kinematics(pk.FiveBar, [0.1, 1.5]), "takes a pk_jax.Mechanism, got ABCMeta"),
        (lambda: pk.inverse_kinematics([0.1, 1.5], five()), "takes a pk_jax.Mechanism, got list"),
        (lambda: pk.screws(None, [0.1, 1.5], [1, 2]), "screws takes a pk_jax.Mechanism, got NoneType"),
        (lambda: pk.stiffness(None, [0.1, 1.5], [1, 2], 1.0), "stiffness takes a pk_jax.Mechanism, got None"),
        (lambda: pk.pose_jacobian("x", [0.1, 1.5], [1, 2]), "pose_jacobian takes a pk_jax.Mechanism, got st"),
        (lambda: pk.draw([0.1, 1.5], five(), [1, 2]), "draw takes a pk_jax.Mechanism, got list"),
        (lambda: pk.forward_kinematics(five(), jax.random.key(0)), "joints must be a number or a regular ar"),
        (lambda: pk.step_reference(None, np.ones(6)), "takes a pk_jax.Mechanism, got NoneType"),
        (lambda: pk.design_space(["2-rpr"]), "design space must be one of 2-rpr, 2-rrr, got ['2-rpr']"),
        (lambda: pk.catalogued({}), "no catalogue entry {}; there are nam-2-rpr"),
        (lambda: pk.workspace_indices(two()(), ["gauss"]), "rule must be one of gauss, midpoint, paper, got"),
        (lambda: pk.workspace_map(five(), 3), "axes must be names, got 3"),
        (lambda: pk.optimize_design(problem, starts=2), "space must come from design_space(...) or be a Des"),
        (lambda: pk.robust(problem(), {"proximal": 0.1}, seed=-1), "seed must be an integer from 0 to 42949"),
        (integral(rule="rays", seed=-1), "seed must be an integer >= 0, got -1"),
        (lambda: pk.evaluate_designs(problem(), [[1.0, 1.5]], devices=[]), "devices must hold at least one"),
    ],
)  # fmt: skip
def test_arguments_of_another_kind(call, expected):
    assert expected in said_by(call)


def test_numbers_that_are_traced_one_by_one_are_an_array():
    joints = jax.jit(lambda x: pk.inverse_kinematics(five(), [x, 1.5]).joints)(0.1)
    np.testing.assert_allclose(joints, pk.inverse_kinematics(five(), [0.1, 1.5]).joints, rtol=1e-14)


def test_masked_numbers_are_none():
    pose = np.ma.masked_array([0.1, 1.5], [True, False])
    assert pk.inverse_kinematics(five(), pose).status == pk.Status.BAD_INPUT


def test_long_doubles_are_numbers():
    assert pk.inverse_kinematics(five(), np.array([0.1, 1.5], np.longdouble)).status == pk.Status.OK


def test_the_poses_of_a_batch_come_to_an_end():
    turns = np.stack([np.eye(3), TURN])
    assert [each.translation[0] for each in pk.SE3(np.eye(2, 3), turns)] == [1, 0]
    assert [float(each.s) for each in pk.AxisPose([0.1, 0.2], turns)] == [0.1, 0.2]
    with pytest.raises(TypeError, match="one SE3 is no batch"):
        iter(pk.SE3(np.zeros(3), TURN))


def test_jacobians_of_many_are_those_of_each():
    poses = np.array([[0.1, 1.5], [0.2, 1.4]])
    joints = pk.inverse_kinematics(five(), poses).joints
    each = [pk.velocity_jacobian(five(), *row) for row in zip(poses, joints, strict=True)]
    np.testing.assert_allclose(pk.velocity_jacobian(five(), poses, joints), each, rtol=1e-14)


def test_all_forty_are_here():
    names = [re.match(r"test_(\d+)_", name) for name in globals()]
    numbers = {int(name[1]) for name in names if name} | {row[0] for row in (*PYTHON, *COMMANDS)}
    assert numbers == set(range(1, 41))
