"""A geometry identified from logged poses and joints."""

import io
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from outsiders import three_rpr
from refusals import said_by

import pk_jax as pk

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

EXAMPLES = Path(__file__).parent.parent / "examples"
LOG = str(EXAMPLES / "hexapod_log.csv")

# Platform x y z, base x y z, L0 in mm: the 42-parameter calibration benchmark of a hexapod machine tool
# (Masory, Wang and Zhuang), nominal and simulated real.
NOMINAL = np.array(
    [
        [92.1597, 84.4488, 0, 305.4001, 111.1565, 0, 604.8652],
        [27.055, 122.037, 0, -56.4357, 320.0625, 0, 604.8652],
        [-119.2146, 37.5882, 0, -248.9644, 208.906, 0, 604.8652],
        [-119.2146, -37.5882, 0, -248.9644, -208.906, 0, 604.8652],
        [27.055, -122.037, 0, -56.4357, -320.0625, 0, 604.8652],
        [92.1597, -84.4488, 0, 305.4001, -111.1565, 0, 604.8652],
    ]
)
REAL = np.array(
    [
        [96.661, 81.7602, 1.0684, 305.2599, 115.0695, 2.621, 604.4299],
        [22.2476, 125.2511, -0.553, -55.2814, 322.9819, 4.2181, 607.2473],
        [-122.4519, 36.6453, 4.3547, -244.7954, 208.0087, 3.9365, 600.4441],
        [-120.6859, -34.4565, -4.9014, -252.5755, -211.8783, -3.0128, 605.9031],
        [24.7769, -125.0489, -4.8473, -53.9678, -320.6115, 4.3181, 604.5251],
        [91.3462, -80.9866, 0.2515, 302.4266, -109.4351, 3.3812, 600.0616],
    ]
)
ROWS = 40
MICROMETRES = 1e-2  # mm, noise of the lengths


def hexapod(table):
    return pk.Stewart(platform=table[:, :3], base=table[:, 3:6])


def about(axis, angle):
    c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
    turn = np.array([[zero + 1, zero, zero], [zero, c, -s], [zero, s, c]]).transpose(2, 0, 1)
    return np.roll(turn, axis, axis=(1, 2))


def turns(angles, order="xyz"):
    """Rotations about the axes, multiplied in an order. -> (rows, 3, 3)"""
    a, b, c = ("xyz".index(axis) for axis in order)
    return about(a, angles[:, a]) @ about(b, angles[:, b]) @ about(c, angles[:, c])


def lengths_of(table, t, rotation):
    """Leg lengths, written out."""
    return np.linalg.norm(
        t[:, None] + np.einsum("nij,kj->nki", rotation, table[:, :3]) - table[:, 3:6], axis=2
    )


def workspace(seed=1, rows=ROWS, tilt=0.35):
    rng = np.random.default_rng(seed)
    t = rng.uniform(-1, 1, (rows, 3)) * (150, 150, 100) + (0, 0, 800)
    return t, turns(rng.uniform(-tilt, tilt, (rows, 3)))


def logged(table=REAL, **options):
    """Poses, and the lengths as a controller of the nominal L0 has them."""
    t, rotation = workspace(**options)
    return pk.SE3(t, rotation), lengths_of(table, t, rotation) - table[:, 6] + NOMINAL[:, 6]


def table_of(found):
    mech = found.mechanism
    return np.c_[mech.platform, mech.base, NOMINAL[:, 6] + found.offsets]


def in_order(table):
    """As the unknowns are numbered."""
    return np.concatenate([table[:, 3:6].ravel(), table[:, :3].ravel(), table[:, 6]])


@pytest.fixture(scope="module")
def benchmark():
    return pk.calibrate(hexapod(NOMINAL), *logged(), offsets=True)


# Recovery


def test_the_benchmarks_42_parameters_are_recovered(benchmark):
    assert benchmark.status == pk.Status.OK and benchmark.rank == len(benchmark.unknowns) == 42
    np.testing.assert_allclose(table_of(benchmark), REAL, atol=1e-8)
    assert benchmark.rms < 1e-10 and benchmark.unidentified == ()
    assert benchmark.unknowns[:4] == ("base[0,0]", "base[0,1]", "base[0,2]", "base[1,0]")
    assert benchmark.unknowns[-1] == "offsets[5]"


def test_no_nominal_geometry_is_needed_and_offsets_may_be_anything():
    poses, lengths = logged()
    start = pk.stewart_from_log(poses, lengths, offsets=True)
    np.testing.assert_allclose(np.c_[start.platform, start.base], REAL[:, :6], atol=1e-7)
    found = pk.calibrate(start, poses, lengths - NOMINAL[:, 6], offsets=True)  # the L0 are not known at all
    np.testing.assert_allclose(found.offsets, REAL[:, 6], atol=1e-8)


def test_deviations_and_covariance_against_monte_carlo():
    rng, truth = np.random.default_rng(7), in_order(REAL)
    poses, lengths = logged()
    runs, spread, variances = 20, [], []
    for _ in range(runs):
        noisy = lengths + MICROMETRES * rng.standard_normal(lengths.shape)
        found = pk.calibrate(hexapod(NOMINAL), poses, noisy, offsets=True)
        assert found.status == pk.Status.OK
        spread.append(in_order(table_of(found)) - truth)
        variances.append(np.diagonal(found.covariance))
    known = pk.calibrate(hexapod(NOMINAL), poses, noisy, offsets=True, sigma=MICROMETRES)
    # the errors that remain say how large the noise is: 198 degrees of freedom a run
    assert abs(np.mean(variances / np.diagonal(known.covariance)) - 1) < 4 * np.sqrt(2 / 198 / runs)
    deviations = np.concatenate([known.deviations[name].ravel() for name in ("base", "platform", "offsets")])
    np.testing.assert_allclose(deviations**2, np.diagonal(known.covariance), rtol=1e-12)
    ratio = np.std(spread, axis=0, ddof=1) / deviations
    assert np.all(np.abs(ratio - 1) < 4 / np.sqrt(2 * runs))
    chi_squared = np.einsum("ri,ij,rj->r", spread, np.linalg.inv(known.covariance), spread) / 42
    assert abs(chi_squared.mean() - 1) < 4 * np.sqrt(2 / 42 / runs)


def test_a_base_frame_that_moves_takes_the_base_with_it(benchmark):
    poses, lengths = logged()
    turn, shift = turns(np.array([[0.3, -0.5, 1.0]]))[0], np.array([100.0, -50.0, 20.0])
    moved = pk.SE3(np.asarray(poses.translation) @ turn.T + shift, turn @ np.asarray(poses.rotation))
    start = hexapod(NOMINAL)
    start = pk.Stewart(base=np.asarray(start.base) @ turn.T + shift, platform=start.platform)
    found = pk.calibrate(start, moved, lengths, offsets=True)
    np.testing.assert_allclose(found.mechanism.base, REAL[:, 3:6] @ turn.T + shift, atol=1e-8)
    np.testing.assert_allclose(found.mechanism.platform, REAL[:, :3], atol=1e-8)
    np.testing.assert_allclose(found.singular_values, benchmark.singular_values, rtol=1e-6)


REACH = (1.2, 3.0)
ARMS = ("half_base", "proximal", "distal")


def five_bar(seed=0, rows=ROWS):
    truth = pk.FiveBar(half_base=1.0, proximal=1.1, distal=2.15, reach=REACH)
    poses = np.random.default_rng(seed).uniform([-0.8, 1.5], [0.8, 2.6], (rows, 2))
    return truth, poses, np.array(pk.inverse_kinematics(truth, poses).joints)


def test_a_five_bar_and_the_zeros_of_its_encoders():
    truth, poses, joints = five_bar()
    start = pk.FiveBar(half_base=1.03, proximal=1.08, distal=2.1, reach=REACH)
    found = pk.calibrate(start, poses, joints - (0.03, -0.05), offsets=True)
    assert found.status == pk.Status.OK and found.unknowns == (*ARMS, "offsets[0]", "offsets[1]")
    for name in ARMS:
        np.testing.assert_allclose(getattr(found.mechanism, name), getattr(truth, name), atol=1e-12)
    np.testing.assert_allclose(found.offsets, (0.03, -0.05), atol=1e-12)
    np.testing.assert_array_equal(found.mechanism.reach, start.reach)  # a limit, no geometry
    assert jax.tree.structure(found.mechanism) == jax.tree.structure(start)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_users_mechanism_from_random_nominal_errors(seed):
    truth, rng = three_rpr(), np.random.default_rng(seed)
    poses = rng.uniform((0.3, 0.2, -0.5), (0.8, 0.7, 0.5), (ROWS, 3))
    ends = turns(poses * (0, 0, 1))[:, :2, :2] @ np.asarray(truth.platform).T
    joints = np.linalg.norm(poses[:, :2, None] + ends - np.asarray(truth.base).T, axis=1)
    worse = [np.asarray(v) + 0.1 * rng.uniform(-1, 1, v.shape) for v in (truth.base, truth.platform)]
    found = pk.calibrate(type(truth)(base=worse[0], platform=worse[1]), poses, joints)
    assert found.status == pk.Status.OK and found.rank == 12
    np.testing.assert_allclose(found.mechanism.base, truth.base, atol=1e-12)
    np.testing.assert_allclose(found.mechanism.platform, truth.platform, atol=1e-12)


def test_only_the_fields_that_are_named_move():
    truth, poses, joints = five_bar()
    start = pk.FiveBar(half_base=1.0, proximal=1.0, distal=2.15, reach=REACH)
    found = pk.calibrate(start, poses, joints, fields=["proximal"])
    assert found.unknowns == ("proximal",) and found.covariance.shape == (1, 1)
    np.testing.assert_allclose(found.mechanism.proximal, truth.proximal, atol=1e-13)
    assert found.mechanism.distal == start.distal and found.mechanism.half_base == start.half_base


def test_errors_are_those_of_the_joints():
    truth, poses, joints = five_bar()
    wrong = joints + 1e-6 * np.random.default_rng(3).standard_normal(joints.shape)
    found = pk.calibrate(truth, poses, wrong, offsets=True)
    again = np.asarray(pk.inverse_kinematics(found.mechanism, poses).joints)
    np.testing.assert_allclose(found.errors, again - (wrong + found.offsets), atol=1e-10)
    np.testing.assert_allclose(found.rms, np.sqrt(np.mean(found.errors**2)), rtol=1e-12)


def test_a_joint_of_great_sigma_hardly_counts():
    truth, poses, joints = five_bar()
    joints[:, 1] += 0.01 * np.random.default_rng(4).standard_normal(ROWS)
    plain = pk.calibrate(truth, poses, joints, offsets=True)
    weighted = pk.calibrate(truth, poses, joints, offsets=True, sigma=(1e-8, 0.01))
    off = [abs(float(found.mechanism.distal - truth.distal)) for found in (plain, weighted)]
    assert off[0] > 1e-4 and off[1] < 1e-7


# What a log does not say


def test_translations_alone_do_not_tell_base_from_platform():
    t = workspace()[0]
    level = np.broadcast_to(np.eye(3), (ROWS, 3, 3))
    lengths = lengths_of(REAL, t, level) - REAL[:, 6] + NOMINAL[:, 6]
    found = pk.calibrate(hexapod(NOMINAL), pk.SE3(t, level), lengths, offsets=True)
    assert found.status == pk.Status.SINGULAR and found.rank == 24 and len(found.unidentified) == 18
    assert set(found.unidentified) == {
        f"base[{i},{j}] + platform[{i},{j}]" for i in range(6) for j in range(3)
    }
    assert np.all(np.isinf(found.deviations["base"])) and np.all(np.isinf(found.deviations["platform"]))
    assert np.all(np.isfinite(found.deviations["offsets"])) and np.all(np.isnan(found.covariance[0, 1:]))
    assert np.all(np.isfinite(found.covariance[36:, 36:]))
    now, before, true = table_of(found), NOMINAL, REAL
    np.testing.assert_allclose(now[:, 6], true[:, 6], atol=1e-7)
    np.testing.assert_allclose((now[:, 3:6] - now[:, :3]), true[:, 3:6] - true[:, :3], atol=1e-7)
    np.testing.assert_allclose((now[:, 3:6] + now[:, :3]), before[:, 3:6] + before[:, :3], atol=1e-9)


def test_fewer_equations_than_unknowns_are_told():
    truth, poses, joints = five_bar()
    joints[2:] = np.nan
    found = pk.calibrate(truth, poses, joints, offsets=True)
    assert found.status == pk.Status.SINGULAR and found.rank == 4 and len(found.unidentified) == 1
    assert found.mechanism.proximal == truth.proximal


def test_a_mechanism_that_only_fits_roughly_keeps_its_status():
    truth, poses, joints = five_bar()
    worse = pk.FiveBar(half_base=1.1, proximal=1.0, distal=2.2, reach=REACH)
    assert pk.calibrate(worse, poses, joints, offsets=True, steps=1).status == pk.Status.STEP_LIMIT
    rough = joints + 0.1 * np.random.default_rng(5).standard_normal(joints.shape)
    found = pk.calibrate(truth, poses, rough, offsets=True)
    assert found.status == pk.Status.OK and 0.05 < found.rms < 0.15


def test_bad_rows_harm_no_other():
    poses, lengths = logged()
    t, rotation = np.array(poses.translation), np.array(poses.rotation)
    t[0, 0], rotation[1] = np.nan, np.nan
    lengths[2, 3], lengths[3, 0] = np.inf, -1.0
    found = pk.calibrate(hexapod(NOMINAL), pk.SE3(t, rotation), lengths, offsets=True)
    assert found.status == pk.Status.OK and found.rows == ROWS - 4
    np.testing.assert_allclose(table_of(found), REAL, atol=1e-8)
    assert list(found.row_status) == [pk.Status.BAD_INPUT] * 4 + [pk.Status.OK] * (ROWS - 4)
    assert np.all(np.isnan(found.errors[:4])) and np.all(np.isfinite(found.errors[4:]))


def test_a_stretched_leg_is_left_out():
    truth, poses, joints = five_bar()
    reach = float(truth.proximal + truth.distal)
    poses[0], joints[0] = (1 + reach * np.cos(1.7), reach * np.sin(1.7)), (1.7, 1.0)
    found = pk.calibrate(truth, poses, joints, offsets=True)
    assert found.row_status[0] == pk.Status.SINGULAR and found.rows == ROWS - 1
    assert found.status == pk.Status.OK and found.rms < 1e-12


# The linear start


def test_nine_legs_and_bad_rows_from_a_log():
    rng = np.random.default_rng(8)
    table = np.concatenate([REAL, np.c_[rng.uniform(-100, 100, (3, 3)), rng.uniform(-300, 300, (3, 4))]])
    t, rotation = workspace(rows=30)
    lengths = lengths_of(table, t, rotation)
    lengths[3, 2], lengths[5, 8], t[7, 1] = np.nan, -1.0, np.inf
    found = pk.stewart_from_log(pk.SE3(t, rotation), lengths)
    np.testing.assert_allclose(np.c_[found.platform, found.base], table[:, :6], atol=1e-7)


@pytest.mark.parametrize(("reach", "noise"), [(1.0, 1e-4), (0.1, 1e-4), (0.001, 1e-8)])
def test_the_linear_start_is_good_for_small_workspaces_too(reach, noise):
    """A tenth of the moves and turns costs two digits, no more."""
    t, rotation = workspace(rows=500, tilt=0.35 * reach)
    t = (t - (0, 0, 800)) * reach + (0, 0, 800)
    lengths = lengths_of(REAL, t, rotation) + noise * np.random.default_rng(9).standard_normal((500, 6))
    found = pk.stewart_from_log(pk.SE3(t, rotation), lengths)
    assert np.abs(np.c_[found.platform, found.base] - REAL[:, :6]).max() < 20 * noise / reach**2


def test_a_real_log_alone_gives_the_geometry(run, tmp_path):
    """Identified from the log of six times as many rows: examples/hexapod.toml."""
    code, out, _ = run("calibrate", LOG, "--unit", "mm", "-o", str(tmp_path / "found.toml"), "--json")
    found, told = pk.load_mechanism(tmp_path / "found.toml"), json.loads(out)
    assert code == 0 and told["status"] == "OK" and told["rows"] == 2000 and told["rank"] == 36
    assert 0.0004 < told["rms"] < 0.0005 and 0.005 < told["greatest"] < 0.01
    known = pk.load_mechanism(EXAMPLES / "hexapod.toml")
    for name in ("base", "platform"):
        np.testing.assert_allclose(getattr(found, name), getattr(known, name), atol=4e-6)
    assert 0.001 < max(told["deviations"]) < 0.002  # mm
    assert (tmp_path / "found.toml").read_text().startswith('family = "Stewart"\nunit = "mm"\n')
    np.testing.assert_allclose(told["values"][:18], 1e3 * np.ravel(found.base), rtol=1e-12)


# The command line


def csv(header, *columns):
    rows = "\n".join(",".join(map(repr, row)) for row in np.column_stack(columns).tolist())
    return f"{header}\n{rows}\n"


@pytest.mark.parametrize("order", ["xyz", "zyx"])
def test_angles_in_degrees_of_either_order_and_offsets(run, tmp_path, order):
    rng = np.random.default_rng(11)
    t, angles = workspace()[0], rng.uniform(-0.35, 0.35, (ROWS, 3))
    lengths = lengths_of(REAL, t, turns(angles, order)) - 5
    log = tmp_path / "log.csv"
    header = "x_mm,y,z,tx_deg,ty,tz,l1,l2,l3,l4,l5_mm,l6" if order == "xyz" else "# numbers alone"
    log.write_text(csv(header, t, np.rad2deg(angles), lengths))
    chosen = () if order == "xyz" else ("--angles", order)
    arguments = (str(log), *chosen, "--unit", "mm", "--offsets", "-o", str(tmp_path / "found.toml"))
    code, out, _ = run("calibrate", *arguments)
    assert code == 0 and "42 of 42 unknowns determined" in out
    np.testing.assert_allclose(
        pk.load_mechanism(tmp_path / "found.toml").base, REAL[:, 3:6] / 1e3, atol=1e-10
    )
    last = out.split("offsets[5]")[1].split()
    assert abs(float(last[0]) - 5) < 1e-6 and float(last[1]) < 1e-6


FIVE_BAR_TOML = (
    'family = "FiveBar"\nunit = "m"\nhalf_base = 1\nproximal = 1.1\ndistal = 2.15\nreach = [1.2, 3]\n'
)


def test_another_family_from_stdin(run, monkeypatch, tmp_path):
    (tmp_path / "start.toml").write_text(FIVE_BAR_TOML.replace("2.15", "2.2"))
    _, poses, joints = five_bar()
    text = csv("t,x_mm,y_mm,q1_rad,q2_rad", np.zeros(ROWS), 1000 * poses, joints + 0.01)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    nominal = str(tmp_path / "start.toml")
    code, out, _ = run("calibrate", "-", "--nominal", nominal, "--unit", "mm", "--offsets", "--json")
    told = json.loads(out)
    assert code == 0 and told["unknowns"][:3] == list(ARMS)
    np.testing.assert_allclose(told["values"], (1000, 1100, 2150, -0.01, -0.01), atol=1e-8)


def test_a_log_that_says_too_little_is_told_and_kept(run, tmp_path):
    _, poses, joints = five_bar()
    poses, joints = (each[np.arange(ROWS) % 2] for each in (poses, joints))  # two rows, over and over
    (tmp_path / "log.csv").write_text(csv("x,y,q1,q2", poses, joints))
    (tmp_path / "start.toml").write_text(FIVE_BAR_TOML)
    arguments = ("--nominal", str(tmp_path / "start.toml"), "--offsets", "-o", str(tmp_path / "found.toml"))
    code, out, _ = run("calibrate", str(tmp_path / "log.csv"), *arguments)
    assert code == 5 and "status SINGULAR" in out and "not determined" in out and "inf" in out
    assert pk.load_mechanism(tmp_path / "found.toml").proximal == 1.1


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        ((LOG,), 2, "column 'x_mm' is in mm"),
        ((LOG, "--unit", "mm", "-o", "found.csv"), 2, "-o must end in .toml"),
        ((LOG, "--unit", "furlong"), 2, "--unit must be one of"),
        ((LOG, "--unit", "mm", "--angles", "xyx"), 2, "--angles"),
        ((LOG, "--nominal", "5-link", "--angles", "xyz"), 2, "--angles: the poses of 5-link"),
        ((LOG, "--nominal", "5-link"), 2, "no columns x,y,q1,q2"),
        (("nowhere.csv",), 4, "nowhere.csv"),
    ],
)
def test_what_the_command_line_refuses(run, arguments, code, expected):
    got, out, err = run("calibrate", *arguments)
    assert got == code and expected in err and out == ""
    assert err.strip().splitlines()[-1].startswith("pk-jax")


# Bad input

FIVE_BAR = pk.FiveBar(half_base=1.0, proximal=1.1, distal=2.15)
POSES, JOINTS = np.full((3, 2), 2.0), np.ones((3, 2))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"mech": 3}, "calibrate takes a pk_jax.Mechanism, got int"),
        ({"poses": POSES[0]}, "poses must be a batch"),
        ({"joints": JOINTS[0]}, "joints must be a batch"),
        ({"poses": POSES[:2]}, "the same number of rows"),
        ({"poses": POSES[:, :1]}, "poses must have shape"),
        ({"poses": POSES[:0], "joints": JOINTS[:0]}, "joints must have at least one row"),
        ({"joints": JOINTS * np.nan}, "none of the 3 rows can be used, the first is BAD_INPUT"),
        ({"fields": ("distal", "lenght")}, "got 'lenght'"),
        ({"fields": "reach"}, "fields must be among half_base, proximal, distal of this FiveBar"),
        ({"fields": ()}, "fields must name at least one field"),
        ({"fields": ("distal", "distal")}, "none twice"),
        ({"sigma": 0.0}, "sigma must be positive"),
        ({"sigma": (1.0, 1.0, 1.0)}, "sigma must have shape () or (2,)"),
        ({"sigma": np.nan}, "sigma must be finite"),
        ({"steps": 0}, "steps must be an integer from 1"),
    ],
)
def test_what_calibrate_refuses(options, expected):
    given = {"mech": FIVE_BAR, "poses": POSES, "joints": JOINTS} | options
    assert expected in said_by(pk.calibrate, **given)


def test_calibrate_within_jit_is_refused():
    said = said_by(jax.jit(lambda q: pk.calibrate(FIVE_BAR, POSES, q).rms), JOINTS)
    assert "outside of jit" in said


def test_more_equations_than_joints_are_refused():
    class Overclosed(pk.FiveBar):
        def residual(self, pose, joints):
            value = super().residual(pose, joints)
            return jax.numpy.append(value, value[0])

    mech = Overclosed(half_base=1.0, proximal=1.1, distal=2.15)
    assert "has 3 for 2" in said_by(pk.calibrate, mech, POSES, JOINTS)


def test_a_geometry_that_is_none_is_refused():
    """The links found reach less far than the start says that they are used."""
    _, poses, _ = five_bar()
    short = pk.FiveBar(half_base=1.0, proximal=1.0, distal=1.9, reach=(1.2, 2.8))
    start = pk.FiveBar(half_base=1.0, proximal=1.1, distal=2.15, reach=REACH)
    joints = pk.inverse_kinematics(short, poses := 0.8 * poses).joints
    assert "FiveBar.reach must increase within" in said_by(pk.calibrate, start, poses, joints, offsets=True)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t, r, q: (t[:15], r[:15], q[:15]), "needs 16 rows or more, got 15"),
        (
            lambda t, r, q: (t, turns(np.c_[0 * t[:, :2], t[:, 0] / 500]), q),
            "must move and turn in all directions",
        ),
        (lambda t, r, q: (t, r, q[:, :5]), "lengths must have six columns"),
        (lambda t, r, q: (t[0], r[0], q), "poses must be a batch"),
        (lambda t, r, q: (t, r, q[0]), "lengths must have shape"),
        (lambda t, r, q: (t, r, np.c_[q[:, :5], q[:, 0]]), "must not give the same leg twice"),
    ],
)
def test_what_stewart_from_log_refuses(change, expected):
    t, rotation = workspace()
    t, rotation, lengths = change(t, rotation, lengths_of(REAL, t, rotation))
    assert expected in said_by(pk.stewart_from_log, pk.SE3(t, rotation), lengths)
