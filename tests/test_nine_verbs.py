"""What the command line does with nine lengths: poses, sensors, the loop; and its figures."""

import json
import re

import numpy as np
import pytest

import pk_jax as pk
from pk_jax.files.named import named_mechanism
from pk_jax.files.simulated import Plant, set_by
from pk_jax.papers import nine_lengths as paper
from pk_jax.viz import nine_lengths as viz

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

NINE = "nine-lengths"


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, tmp_path):
    monkeypatch.setattr("pk_jax.cli._compile_cache", lambda: None)
    monkeypatch.chdir(tmp_path)


def columns(text):
    header, *rows = [line.split(",") for line in text.splitlines()]
    return dict(zip(header, zip(*rows, strict=True), strict=True))


@pytest.fixture(scope="module")
def logged():
    """Lengths of four poses in mm, with noise of 10 um; the third row is spoilt."""
    robot, rng = pk.catalogued(NINE), np.random.default_rng(3)
    poses = paper.random_poses(rng, 4)
    lengths = 1e3 * paper.lengths_of(robot, poses) + 1e-2 * rng.standard_normal((4, 9))
    lengths[2, 4] = np.nan
    return poses, lengths


def test_fk_of_nine_lengths_needs_no_guess_and_tells_its_deviations(run, tmp_path, logged):
    poses, lengths = logged
    path = tmp_path / "lengths.csv"
    np.savetxt(path, lengths, delimiter=",", header=",".join(f"l{i}_mm" for i in range(1, 10)), comments="")
    code, out, err = run("fk", NINE, path, "--unit", "mm", "--closed-form", "--sigma", "0.01,0.01")
    found = columns(out)
    assert code == 0 and "3 OK, 1 BAD_INPUT" in err
    assert found["status"] == ("OK", "OK", "BAD_INPUT", "OK")
    good = [0, 1, 3]
    at = np.array([found[name] for name in "xyz"], float).T[good]
    spread = np.array([found[f"sd_{name}"] for name in "xyz"], float).T[good]
    off = np.abs(at - 1e3 * np.asarray(poses.translation)[good])
    assert np.all(off < 5 * spread) and np.all((spread > 1e-3) & (spread < 0.1))
    assert float(found["z_squared"][0]) > 1e4
    assert run("fk", NINE, path, "--unit", "mm", "--closed-form", "--strict")[0] == 3


def test_it_refuses_what_has_no_nine_lengths(run, tmp_path):
    (tmp_path / "rows.csv").write_text("1,1,1\n")
    for arguments, said in (
        (("fk", "3-rrr", "rows.csv", "--closed-form"), "--closed-form takes a pk_jax.Stewart, got PlanarRRR"),
        (("fk", "3-rrr", "rows.csv", "--sigma", "1,1"), "--sigma is for --closed-form"),
        (("fk", NINE, "rows.csv", "--closed-form", "--sigma", "1"), "--sigma must be two positive numbers"),
        (
            ("fk", NINE, "rows.csv", "--closed-form", "--sigma", "1,-1"),
            "--sigma must be two positive numbers",
        ),
        (("simulate", "hexapod-log"), "simulate takes a Stewart with nine rows"),
        (("simulate", NINE, "--feedback", "eye"), "--feedback must be one of joint, legs"),
        (("simulate", NINE, "--plant", "mass=1"), "--plant must name one of period"),
        (("simulate", NINE, "--plant", "noise=loud"), "--plant must be NAME=VALUE"),
        (("simulate", NINE, "--plant", "lag=-1"), "plant.lag must be a finite number >= 0"),
        (("simulate", NINE, "--plant", "delay=inf"), "plant.delay must be a finite number >= 0"),
        (("simulate", NINE, "--plant", "delay=nan"), "plant.delay must be a finite number >= 0"),
        (("simulate", NINE, "--gain", "kp=inf"), "gains.kp must be finite"),
        (("simulate", NINE, "--radius", "-1"), "radius must be positive"),
        (("simulate", NINE, "--reference", "step", "--twist", "1,2"), "--twist must be six numbers"),
        (("simulate", NINE, "--seeds", "0"), "seeds must be an integer from 1"),
        (("simulate", NINE, "-o", "errors.gif"), "-o must end in .png"),
        (("sensors", "3-rrr"), "sensors takes a Stewart"),
        (("sensors", "hexapod-log"), "sensor_layout takes a Stewart with nine rows"),
        (("sensors", NINE, "--place-platform", "1"), "--place-platform needs --place"),
        (("sensors", NINE, "--place", "0"), "radius must be positive"),
        (("sensors", NINE, "-o", "placed.csv"), "-o must end in .toml"),
    ):
        code, out, err = run(*arguments)
        assert code == 2 and not out and said in err, (arguments, err)
        assert len(err.splitlines()) == 1


def test_sensors_are_judged(run):
    code, out, _ = run("sensors", NINE, "--unit", "mm")
    assert code == 0 and "planar base, linear stage of rank 6 of 6, condition 4.101" in out
    assert "rotation (rad/mm): median" in out


@pytest.mark.soak
def test_sensors_are_placed(run, tmp_path):
    code, out, _ = run("sensors", NINE, "--place", "1", "--starts", "2", "-o", "placed.toml")
    assert code == 0 and "planar base, linear stage of rank 6 of 6" in out and "status OK" in out
    placed, before = pk.load_mechanism("placed.toml"), pk.catalogued(NINE)
    assert np.allclose(placed.base[:6], before.base[:6]) and not np.allclose(placed.base[6:], before.base[6:])
    assert np.max(np.abs(placed.base[6:])) <= 1 + 1e-12
    gain, gain_before = map(float, re.search(r"RMS gain ([\d.]+), ([\d.]+) with", out).groups())
    assert gain < 0.95 * gain_before


def test_a_singular_layout_is_refused_with_its_rank(run):
    _, base, platform = paper.singular_layouts()["6-3, sensors on the lines through the feet of the pairs"]
    pk.save_mechanism(pk.Stewart(base=base, platform=platform), "paired.toml", unit="m")
    code, out, _ = run("sensors", "paired.toml")
    assert code == 5 and "rank 3 of 6" in out and "REFUSED: the layout is singular" in out


@pytest.mark.parametrize("name", paper.singular_layouts())
def test_singular_layouts_have_the_rank_that_is_stated(name):
    rank, base, platform = paper.singular_layouts()[name]
    values = np.asarray(paper.singular_values(base, platform))
    assert np.sum(values > 1e-9 * values[0]) == rank


def test_the_loop_is_simulated_drawn_and_written(run, tmp_path):
    options = ("simulate", NINE, "--unit", "mm", "--feedback", "joint", "--seeds", "2", "--duration", "1.2")
    given = ("--plant", "encoder_bias=0.1", "--plant", "noise=0", "--plant", "quantum=0")
    code, out, _ = run(*options, *given, "--json", "-o", "errors.png", "--csv", "samples.csv")
    row = json.loads(out)["feedback"]["joint"]
    assert code == 0 and row["not_ok"] == 0
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    found = columns((tmp_path / "samples.csv").read_text())
    assert len(found["time"]) == 2 * 1200 and set(found["seed"]) == {"0", "1"}
    off = np.array(found["position_error"], float).reshape(2, 1200)
    counted = np.array(found["time"], float)[:1200] >= 1.1  # half way from the ramp's end to the end
    assert np.isclose(row["rms_position"], np.sqrt(np.mean(off[:, counted] ** 2)), rtol=1e-9)
    assert 0.01 < row["rms_position"] < 1  # mm: of the order of the encoders' bias
    text = run(*options, *given)[1]
    assert "RMS position (mm)" in text and "2 seeds" in text


def test_options_set_plants_in_the_unit_of_the_user():
    found = set_by(["noise=2", "lag=0.5", "delay=3"], "--plant", Plant(), 1e-3)
    assert found == Plant(noise=2e-3, lag=0.5, delay=3) and isinstance(found.delay, int)


def test_the_figures_of_the_patent_show_every_joint(tmp_path):
    for name in (NINE, "nine-lengths-general"):
        robot = named_mechanism(name).mechanism
        axes = viz.draw_platform(robot, *robot.home())
        names = {text.get_text() for text in axes.texts}
        assert names == {
            f"${letter}_{i}$"
            for letter, n in (("A", 6), ("B", 6), ("S", 3), ("T", 3))
            for i in range(1, n + 1)
        }
    plan = {text.get_text() for text in viz.platform_plan(robot).texts}
    assert {"$h_1$", "$h_2$", "$p$", "$T_3$", "$B_6$"} <= plan
    loop = {text.get_text() for text in viz.control_diagram().texts}
    assert {"$X_d$", "$E$", "$A$", "$L$", "$X_a$"} <= loop


@pytest.mark.soak
def test_exact_lengths_of_random_layouts_give_their_poses():
    for embodiment in paper.EMBODIMENTS:
        found = paper.exact_lengths(embodiment, 3, 5, lambda *_: None)
        assert found.right == found.poses == 15 and found.worst < 1e-12


@pytest.mark.soak
def test_the_noise_table_counts_and_draws():
    rows = list(paper.noisy_lengths(2, 1, 20, lambda *_: None))
    assert [row.noise for row in rows] == list(paper.NOISES)
    assert all(row.rows == 20 and row.gross == row.not_ok == 0 for row in rows)
    assert all(row.median < row.median_closed for row in rows)
    axes = viz.draw_noise(rows)
    assert len(axes.get_lines()) == 6 and axes.get_xscale() == axes.get_yscale() == "log"


@pytest.mark.soak
def test_the_whole_report(run, tmp_path):
    code, out, _ = run("reproduce", "nine-lengths", "--out", tmp_path / "run")
    assert code == 0 and "rank 5 of 6" in out
    assert {"fig1_platform.png", "fig4_loop.png", "circle.json"} <= {
        p.name for p in (tmp_path / "run").iterdir()
    }
