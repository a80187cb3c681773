"""What verbs and run folders do in rare cases, asked directly: verbs would take seconds each."""

import io
import json
import zipfile

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import small_runs
from refusals import said_by

import pk_jax as pk
from pk_jax import Status
from pk_jax.design.sensor_placement import SensorPlacement
from pk_jax.files import assembled, checkpoint, design_run, limits, run_file, sensed, shards, simulated
from pk_jax.files.named import named_mechanism
from pk_jax.files.run_file import parse_run
from pk_jax.files.run_folder import run_folder
from pk_jax.files.shown import Jacobians, as_text
from pk_jax.files.singular import locus_text
from pk_jax.kinematics.modes.roadmap import Link

pytestmark = pytest.mark.usefixtures("compiled_in_haste")

RPR = named_mechanism("nam-2-rpr")


# ---------------------------------------------------------------- assembly modes


@pytest.fixture
def modes():
    joints = np.array([[2.2, 2.4], [2.5, 2.1]])
    return assembled.assembled(RPR, joints)


def test_modes_and_whether_they_can_be_reached(modes, monkeypatch):
    ways = lambda mech, row, each: type("Ways", (), {"to_home": np.array([Link.PATH, Link.NOT_FOUND])})
    monkeypatch.setattr(assembled, "connect_modes", ways)
    said = []
    many = assembled.assembled(RPR, modes.joints, connect=True, report=lambda *line: said.append(line))
    assert [line for line in said if "paths" in line[0]] == [
        ("paths from home: rows", 1, 2),
        ("paths from home: rows", 2, 2),
    ]
    assert "from home" in assembled.modes_text(many)
    one = assembled.assembled(RPR, modes.joints[:1], connect=True)
    text = assembled.modes_text(one)
    assert "from home" in text and "path" in text and "not found" in text


def test_why_modes_are_complete_or_not(modes):
    of = lambda **known: assembled.because(modes.modes[0]._replace(**known))
    assert of(status=np.int32(Status.BAD_INPUT)) == "not complete: such joints are none"
    assert of(is_complete=np.True_, expected=np.int32(-1)) == "complete: all that the closed form knows"


# ---------------------------------------------------------------- maps, certificates, integrals, loci


def test_a_range_of_what_is_not_on_an_axis():
    said = said_by(limits.map_of, RPR, "x", None, ["x=0:1", "y=1:2"], None, None, 4)
    assert said == "--range y: not one of --axes x"


def test_a_map_of_which_all_is_inside():
    found, travels = limits.map_of(RPR, None, None, ["x=-0.01:0.01", "y=1.8:1.82"], None, None, 4)
    text = limits.map_text(RPR, found, travels)
    assert "100.00% of the box is inside" in text and "outside by" not in text


def test_a_certificate_takes_the_whole_stroke_of_a_free_joint(monkeypatch):
    asked = {}

    def certify(mech, ranges, **_):
        asked.update(ranges)
        return "proved"

    monkeypatch.setattr(limits, "certify_regular", certify)
    casing = named_mechanism("casing-oscillator")
    assert limits.certificates_of(casing, ["s=0.4:0.5"], 0.0, None, 10, None) == {"regular": "proved"}
    free = np.asarray(casing.mechanism.free_range())[0]
    monkeypatch.setattr(limits, "certify_confined", certify)
    whole = [f"{name}=-0.1:0.1" for name in ("s", "roll", "pitch", "yaw")]
    both = limits.certificates_of(casing, whole, 0.0, "stroke_min,stroke_max", 10, None)
    assert both == {"regular": "proved", "confined": "proved"}
    asked.clear()
    limits.certificates_of(casing, ["s=0.4:0.5"], 0.0, None, 10, None)
    assert list(asked) == ["E", "s"] and tuple(asked["E"]) == tuple(free) and tuple(asked["s"]) == (0.4, 0.5)


def test_an_integral_is_told_with_its_errors():
    found = pk.workspace_integral(RPR.mechanism, ("isotropy",), rule="panels", nodes=4)
    lines = limits.integral_text(RPR, ["isotropy"], found).splitlines()
    assert lines[0] == "nam-2-rpr: OK, lengths in m"
    assert [line.split()[0] for line in lines[1:4]] == ["volume", "integral", "mean"]
    assert f"{float(found.volume):.12g}  +- " in lines[1]


def test_a_locus_of_nothing_and_one_of_everything():
    empty = pk.singularity_locus(RPR.mechanism, ranges=((-0.1, 0.1), (1.7, 1.9)), kinds=("II",), nodes=5)
    assert not empty.curves and locus_text(RPR, empty).endswith("none found")
    everywhere = empty._replace(everywhere=((pk.SingularityKind.TYPE_II, np.array([1.0, -1.0])),))
    assert "TYPE_II everywhere in working mode +-" in locus_text(RPR, everywhere)


def test_jacobians_where_the_pose_is_none():
    two = {"x": 1.0, "y": 2.0}
    found = Jacobians("m", two, two, "SINGULAR", np.eye(2), np.eye(2), np.full((2, 2), np.nan), 0.0, 1.0)
    assert "status SINGULAR" in as_text(found) and "status" not in as_text(found._replace(status="OK"))


# ---------------------------------------------------------------- sensors, control


def test_sensors_that_were_placed_are_told(monkeypatch):
    nine = named_mechanism("nine-lengths", "mm")
    assert said_by(sensed.sensed, nine, None, 0.3, 4, None) == "--place-platform needs --place"
    one = sensed.sensed(nine, None, None, 4, None)
    placement = SensorPlacement(nine.mechanism, 1.25, np.inf, one.layout, np.ones(4), 77, Status.OK)
    asked = {}
    monkeypatch.setattr(sensed, "place_sensors", lambda *_, **given: asked.update(given) or placement)
    placed = sensed.sensed(nine, 300.0, 200.0, 4, None)
    assert (asked["radius"], asked["platform_radius"], asked["starts"]) == (0.3, 0.2, 4)
    assert placed.placement is placement and placed.mechanism is nine.mechanism
    text = sensed.sensed_text(nine, one._replace(placement=placement))
    assert "placed: RMS gain 1.25; 77 gradients, status OK" in text
    x = float(nine.mechanism.base[6, 0]) * 1000
    assert f"  S1  {x:.6g}, " in text and "  T3  " in text
    known = sensed.sensed_text(nine, one._replace(placement=placement._replace(gain_before=2.5)))
    assert "RMS gain 1.25, 2.5 with the sensors it came with" in known


def test_a_step_is_six_numbers():
    nine = named_mechanism("nine-lengths", "mm")
    for wrong in ("1,2,3", "a,b,c,d,e,f", ""):
        assert said_by(simulated.experiment_of, nine, "step", [], [], twist=wrong).startswith(
            "--twist must be"
        )
    size = float(nine.mechanism.length())
    np.testing.assert_allclose(simulated._twist("10,0,0,0,0,0.1", size, 1e-3), [0.01, 0, 0, 0, 0, 0.1])
    np.testing.assert_allclose(simulated._twist(None, size, 1e-3)[:3], np.array([0.06, -0.04, 0.04]) * size)


# ---------------------------------------------------------------- runs


@pytest.fixture
def run(monkeypatch):
    monkeypatch.setattr(run_file, "problem_of", small_runs.small_problem)
    monkeypatch.setattr(design_run, "SAVE_EVERY", 0.0)
    return parse_run(small_runs.TEXT.encode(), "mine.toml")


def contents(folder):
    return {name: (folder / name).read_bytes() for name in small_runs.RESULTS}


def test_one_host_together_is_a_run(run, tmp_path):
    design_run.run_into(tmp_path / "alone", run)
    said, drawn = [], []
    draw = lambda folder, design, history: drawn.append(len(history))
    found = shards.together_into(tmp_path / "together", run, report=said.append, draw=draw)
    assert found.design is not None and said and drawn
    assert contents(tmp_path / "together") == contents(tmp_path / "alone")
    assert shards.together_into(tmp_path / "together", run, resume=True).design is None  # finished
    with pytest.raises(ValueError, match="a finished run"):
        shards.together_into(tmp_path / "together", run)


def test_a_host_that_is_not_the_first_writes_nothing(run, tmp_path, monkeypatch):
    began = design_run.begun(run, shards.Part())
    ended = design_run.search_from(began, None, run, shards.Part(), design_run.on_devices(run, None), None)
    assert ended.is_over(run) and len(ended.history)
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    monkeypatch.setattr("jax.experimental.multihost_utils.broadcast_one_to_all", lambda tree: tree)
    monkeypatch.setattr(shards, "search_from", lambda state, folder, *_: ended)
    assert shards.together_into(tmp_path / "a", run).design is None
    assert not (tmp_path / "a").exists()
    refused = np.int32(shards._REFUSED)
    monkeypatch.setattr("jax.experimental.multihost_utils.broadcast_one_to_all", lambda tree: refused)
    with pytest.raises(ValueError, match="the first process has refused the run"):
        shards.together_into(tmp_path / "a", run)


def test_hosts_are_connected_or_told(monkeypatch):
    asked = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *given, **_: asked.append(given))
    shards.connect("localhost:1234", shards.Part(2, 3))
    assert asked == [("localhost:1234", 3, 1)]

    def fails(*_, **__):
        raise RuntimeError("nobody there")

    monkeypatch.setattr(jax.distributed, "initialize", fails)
    said = said_by(shards.connect, "localhost:1234", shards.Part(2, 3))
    assert said == "--coordinator localhost:1234: nobody there"


def test_results_without_their_run_are_left_alone(run, tmp_path):
    design_run.run_into(tmp_path / "a", run)
    (tmp_path / "a" / design_run.CONFIG).unlink()
    assert "holds a run without its" in said_by(design_run.run_into, tmp_path / "a", run, resume=True)


def test_checkpoints_of_another_size_or_version(tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ones(2), version=(2, 0))
    header = io.BytesIO()
    said = {"format": checkpoint.FORMAT, "arrays": {"x": ["<f8", [2]]}}
    np.lib.format.write_array(header, np.frombuffer(json.dumps(said).encode(), np.uint8), version=(1, 0))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{checkpoint.HEADER}.npy", header.getvalue())
        archive.writestr("x.npy", stream.getvalue())
    assert "x is of another version of the format" in said_by(checkpoint.read_saved, path)
    monkeypatch.setattr(checkpoint, "LARGEST", 10)
    assert "more than 10 bytes" in said_by(checkpoint.read_saved, path)


def test_a_folder_that_cannot_be_locked(tmp_path):
    (tmp_path / "a" / ".lock").mkdir(parents=True)
    with pytest.raises(IsADirectoryError), run_folder(tmp_path / "a"):
        pass


def test_a_figure_in_a_run_folder_is_a_png(tmp_path):
    figure = plt.figure()
    with run_folder(tmp_path / "a") as folder:
        path = folder.write_figure("nothing.png", figure)
    plt.close(figure)
    assert path.read_bytes().startswith(b"\x89PNG")
