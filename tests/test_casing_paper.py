"""The paper on the casing oscillator: mobility, eq. (18), its claims; and the verbs that it brought."""

import csv
import io
import json
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import pk_jax as pk
from pk_jax.cli import main
from pk_jax.papers import casing_oscillator as paper
from pk_jax.papers.casing_oscillator_claims import claims
from pk_jax.viz import casing_oscillator as viz
from pk_jax.viz.singularity import draw_screws
from pk_jax.viz.workspace_map import draw_map

DEG = np.pi / 180
FIGURES = {
    "fig2_model.png",
    "fig3_travel.png",
    "fig4_roll_yaw.png",
    "fig5_pitch_yaw.png",
    "fig6_locus_roll_yaw.png",
    "fig7_locus_pitch_yaw.png",
    "fig8_fig9_singular.png",
}


@cache
def machine():
    return pk.CasingOscillator()


def configuration(s=0.46, roll=0.2, pitch=-0.1, yaw=0.3, carriage=0.7):
    pose = pk.AxisPose.from_angles(s, roll, pitch, yaw)
    return pose, machine().inverse(pose, free=carriage)


def certificate(is_proved):
    nothing = np.zeros((0, 5))
    names = ("s", "roll", "pitch", "yaw", "E")
    return pk.Certificate(is_proved, 0.5, 1, names, np.zeros(5), np.ones(5), (nothing, nothing))


@cache
def verdicts(is_proved=True):
    proof = paper.Proof(certificate(True), certificate(is_proved))
    return {claim.said: claim for claim in claims(machine(), proof)}


def run(capsys, *arguments):
    """(exit code, stdout, stderr)"""
    code = main(list(arguments))
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setattr("pk_jax.cli._compile_cache", lambda: None)


# --- eq. (9)


def test_the_model_of_fig_2_has_the_bodies_joints_and_freedoms_of_eq_9():
    assert paper.BODIES == 14
    assert sum(each.count for each in paper.JOINTS) == 17
    assert sum(each.count * each.freedoms for each in paper.JOINTS) == 31
    assert paper.mobility(paper.BODIES, paper.JOINTS, paper.PASSIVE) == 4


def test_without_the_passive_ones_these_are_the_joints_and_two_legs_that_spin():
    pose, joints = machine().home()
    a, b = pk.pose_jacobian(machine(), pose, joints), pk.joint_jacobian(machine(), pose, joints)
    motions = a.shape[1] + b.shape[1] - np.linalg.matrix_rank(np.concatenate([a, b], axis=1))
    assert paper.mobility(paper.BODIES, paper.JOINTS) == motions + 2 == 7


def test_mobility_of_known_mechanisms():
    four_bar = (paper.Joints("revolute", 4, 1),)
    stewart = (paper.Joints("prismatic", 6, 1), paper.Joints("spherical", 12, 3))
    assert paper.mobility(4, four_bar, space=3) == 1
    assert paper.mobility(14, stewart, passive=6) == 6


# --- eq. (18)


def test_eq_18_in_the_casing_frame_is_the_exact_jacobian():
    pose, joints = configuration()
    found = paper.in_tangent(paper.printed_jacobian(machine(), pose, joints, "casing"), pose, "casing")
    np.testing.assert_allclose(found, pk.pose_jacobian(machine(), pose, joints), rtol=0, atol=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_eq_18_in_base_axes_is_exact_for_an_upright_casing(yaw):
    pose, joints = configuration(roll=0.0, pitch=0.0, yaw=yaw)
    found = paper.in_tangent(paper.printed_jacobian(machine(), pose, joints), pose)
    np.testing.assert_allclose(found, pk.pose_jacobian(machine(), pose, joints), rtol=0, atol=1e-15)


def test_eq_18_in_base_axes_is_eqs_14_16_17():
    """l . C' + (b x l) . w with x' = -y wz + z wy and y' = x wz - z wx."""
    pose, joints = configuration()
    rotation, centre = np.asarray(pose.rotation), float(pose.s) * np.asarray(pose.rotation)[:, 2]
    arms = np.asarray(machine().attachments()) @ rotation.T
    legs = centre + arms - np.asarray(machine().base(joints[4]))
    rng = np.random.default_rng(0)
    for z_rate, *turn in rng.normal(size=(5, 4)):
        swept = np.cross(turn, centre)
        velocity = np.array([swept[0], swept[1], z_rate])
        expected = legs @ velocity + np.cross(arms, legs) @ turn
        found = paper.printed_jacobian(machine(), pose, joints) @ np.array([z_rate, *turn])
        np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_eq_18_in_base_axes_is_a_fifth_off_at_a_roll_of_15_degrees():
    assert 0.15 < paper.largest_misprint(machine(), pk.AxisPose.from_angles(0.48, 15 * DEG)) < 0.25


def test_another_frame_is_refused():
    with pytest.raises(ValueError, match="frame must be"):
        paper.printed_jacobian(machine(), *configuration(), "platform")


# --- singular poses and claims


def test_singular_angles_are_those_of_the_closed_form():
    assert paper.singular_pitch(machine(), 0.48) / DEG == pytest.approx(62.487997376149, abs=1e-11)
    assert paper.singular_roll(machine(), 0.48) / DEG == pytest.approx(75.297830305966, abs=1e-11)
    for name, angle in (("pitch", paper.singular_pitch), ("roll", paper.singular_roll)):
        pose, joints = configuration(
            0.5, **{"roll": 0.0, "pitch": 0.0, "yaw": 0.0, name: angle(machine(), 0.5)}
        )
        size = abs(paper.determinants(machine(), *machine().home()).numerical)
        assert max(map(abs, paper.determinants(machine(), pose, joints))) < 1e-14 * size


def test_every_case_is_what_it_should_be():
    cases = paper.singular_cases(machine())
    assert {case.kind for case in cases} == {pk.SingularityKind.TYPE_II, pk.SingularityKind.REGULAR}
    for case in cases:
        assert pk.classify_singularity(machine(), case.pose, case.joints).kind == case.kind, case.title


VERDICTS = {
    "4 degrees of freedom": "holds",
    "leg rates of z' and w in base axes": "holds in part",
    "travel by pitch about 100 mm, whatever s": "holds",
    "travel by roll about 300 mm at the neutral s, less beside it": "holds in part",
    "near neutral 20-25 deg of roll, about 20 deg of yaw": "holds in part",
    "10-15 deg of pitch, 20-25 deg of yaw": "holds",
    "singular at roll +-90 and pitch +-75 deg": "does not hold",
    "singular angles hardly depend on yaw": "holds in part",
    "loci nearly unchanged for s = 420..520 mm": "does not hold",
    "singular where eq. (29) or eq. (32) holds": "does not hold",
    "no singularity in the workspace": "holds",
}


def test_the_claims_are_judged():
    assert {said: claim.verdict for said, claim in verdicts().items()} == VERDICTS


def test_the_numbers_of_the_claims():
    found = {said: claim.found for said, claim in verdicts().items()}
    assert "95.1, 99.1, 102.3 mm" in found["travel by pitch about 100 mm, whatever s"]
    assert "239.8" in found["travel by roll about 300 mm at the neutral s, less beside it"]
    assert "+-18.21 deg" in found["travel by roll about 300 mm at the neutral s, less beside it"]
    assert "roll 71.4 to 77.3, pitch 59.2 to 64.3" in found["loci nearly unchanged for s = 420..520 mm"]


def test_without_a_proof_the_last_claim_stays_open():
    last = verdicts(False)["no singularity in the workspace"]
    assert (last.verdict, last.found) == ("open", "not proved")


def test_judging_depends_on_the_machine():
    """A machine with wide strokes travels farther than the paper says."""
    strokes = np.asarray(machine().stroke) + [-0.05, 0.05]
    wide = pk.CasingOscillator(stroke=strokes, base_cone=1.0, platform_cone=1.0)
    proof = paper.Proof(certificate(True), certificate(True))
    judged = {claim.said: claim.verdict for claim in claims(wide, proof)}
    assert judged["travel by pitch about 100 mm, whatever s"] == "does not hold"
    assert judged["10-15 deg of pitch, 20-25 deg of yaw"] == "does not hold"


# --- figures


def test_the_model_is_drawn_with_its_names():
    ax = viz.model(machine(), *machine().home())
    texts = {text.get_text() for text in ax.texts}
    assert {"$B_1$", "$b_4$", "$l_3$", "$E$", "$O$", "$C$"} <= texts


def test_lines_of_action_run_along_the_legs():
    case = paper.singular_cases(machine())[0]
    ax = draw_screws(case.mechanism, case.pose, case.joints)
    dashed = [np.array(line.get_data_3d()).T for line in ax.lines if line.get_linestyle() == "--"]
    assert len(dashed) == 4
    points = np.asarray(machine().skeleton(case.pose, case.joints).points)
    for (start, end), line in zip(((0, 3), (1, 4), (2, 5), (0, 6)), dashed, strict=True):
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        for point in points[[start, end]]:
            assert np.linalg.norm(np.cross(point - line[0], along)) < 1e-12


def test_the_free_turn_is_drawn_through_o_where_there_is_one():
    drawn = []
    for case in (paper.singular_cases(machine())[k] for k in (0, 3)):
        ax = draw_screws(case.mechanism, case.pose, case.joints)
        drawn.append([line for line in ax.lines if line.get_linestyle() == "-."])
    assert [len(lines) for lines in drawn] == [1, 0]
    ends = np.array(drawn[0][0].get_data_3d()).T
    np.testing.assert_allclose(ends.sum(axis=0), 0, atol=1e-12)
    assert np.linalg.norm(np.cross(ends[0], [0, 1, 0])) < 1e-6  # Fig. 8: about Y


def test_a_map_over_three_axes_is_refused_by_name():
    found = pk.workspace_map(machine(), "roll,pitch,yaw", ranges=[(-0.1, 0.1)] * 3, nodes=3)
    with pytest.raises(ValueError, match="two axes"):
        draw_map(found)


# --- the command line


def test_map_says_travels_and_writes_every_node(capsys, tmp_path):
    table, image = tmp_path / "map.csv", tmp_path / "map.png"
    arguments = ("map", "casing-oscillator", "--axes", "roll,yaw", "--unit", "mm", "--nodes", "21")
    code, out, _ = run(capsys, *arguments, "--csv", str(table), "-o", str(image))
    assert code == 0
    assert "roll   -0.252441" in out and "417.5 .. 542.5 mm" in out and "21 nodes" in out
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert len(rows) == 21**2 and set(rows[0]) == {"roll", "yaw", "margin", "limit"}
    middle = rows[21 * 10 + 10]
    assert abs(float(middle["roll"])) < 1e-12 and float(middle["margin"]) == pytest.approx(
        0.0603074, abs=1e-6
    )
    assert image.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_map_takes_a_range_a_pose_and_a_carriage(capsys):
    arguments = ("map", "casing-oscillator", "--range", "roll=-0.1:0.1", "--range", "yaw=-0.1:0.1")
    code, out, _ = run(capsys, *arguments, "--nodes", "5", "--at", "0.47,0,0.02,0", "--free", "0.72")
    assert code == 0 and "roll   -0.1 .. 0.1 rad" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["map", "delta-robot"], "no mechanism"),
        (["map", "semi-regular-stewart"], "has no margins"),
        (["map", "casing-oscillator", "--free", "everywhere"], "--free must be numbers E or any"),
        (["map", "nam-2-rpr", "--free", "1"], "no kinematically redundant joint"),
        (["map", "casing-oscillator", "--range", "tilt=0:1"], "--range must name one of"),
        (["map", "casing-oscillator", "--range", "roll=0-1"], "NAME=LOWER:UPPER"),
        (["map", "casing-oscillator", "-o", "map.bmp"], "must end in"),
        (["certify", "casing-oscillator"], "--range must be given"),
        (["certify", "casing-oscillator", "--range", "roll=1:0"], "lower <= upper"),
        (["certify", "casing-oscillator", "--range", "E=0.7"], "NAME=LOWER:UPPER"),
        (["certify", "5-link", "--range", "x=0:0.01"], "depends on joints"),
    ],
)
def test_bad_input_is_told_in_one_line(capsys, arguments, said):
    code, out, err = run(capsys, *arguments)
    assert code == 2 and out == "" and said in err.splitlines()[-1] and len(err.strip().splitlines()) == 1


def test_certify_proves_and_says_when_it_could_not(capsys):
    code, out, _ = run(
        capsys, "certify", "casing-oscillator", "--range", "roll=-0.2:0.2", "--range", "E=0.7:0.75"
    )
    assert code == 0 and "PROVED: no type II singularity" in out and "NOT" not in out
    code, out, _ = run(capsys, "certify", "casing-oscillator", "--range", "roll=-1.4:1.4", "--most", "100")
    assert code == 5 and "NOT PROVED" in out


@pytest.mark.soak
def test_certify_of_all_coordinates_proves_that_they_cannot_be_left(capsys):
    spans = ("s=400:560", "roll=-0.5:0.5", "pitch=-0.5:0.5", "yaw=-0.5:0.5")  # wide: few boxes
    ranges = [each for span in spans for each in ("--range", span)]
    arguments = ("certify", "casing-oscillator", "--unit", "mm", "--within", "stroke_min,stroke_max")
    code, out, _ = run(capsys, *arguments, *ranges)
    assert code == 0 and out.count("PROVED: no") == 2


def test_ik_takes_a_carriage_or_a_way_to_choose_it(capsys, tmp_path):
    rows = tmp_path / "poses.csv"
    rows.write_text("s,roll,pitch,yaw\n480,0.1,0.1,0\n470,0,-0.05,0.1\n")
    found = {}
    for free in ("700", "margin"):
        code, out, _ = run(capsys, "ik", "casing-oscillator", str(rows), "--unit", "mm", "--free", free)
        assert code == 0
        found[free] = np.array([[float(v) for v in line.split(",")[:5]] for line in out.splitlines()[1:]])
    assert np.all(found["700"][:, 4] == 700)
    pose = pk.AxisPose.from_angles(jnp.array([0.48, 0.47]), [0.1, 0.0], [0.1, -0.05], [0.0, 0.1])
    best = pk.resolve_redundancy(machine(), pose)
    np.testing.assert_allclose(found["margin"], 1e3 * np.asarray(best.joints), rtol=1e-12)


@pytest.mark.soak
def test_the_whole_report(capsys, tmp_path):
    code, out, _ = run(capsys, "reproduce", "casing-oscillator", "--out", str(tmp_path / "run"))
    assert code == 0 and "PROVED" not in out and out.count("HOLD") >= len(VERDICTS)
    names = {file.name for file in (tmp_path / "run").iterdir()}
    assert names == FIGURES | {"claims.json", "proof.json", "singular.csv"}
    proof = json.loads((tmp_path / "run" / "proof.json").read_text())
    assert proof["regular"]["is_proved"] and proof["confined"]["is_proved"]
    assert proof["regular"]["bound"] > 0.5
