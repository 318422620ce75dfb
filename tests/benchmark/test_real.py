import numpy as np
import pytest

from ljn.benchmark.labels import joint_map, read_labelled_frames
from ljn.benchmark.offsets import fit_offsets
from ljn.benchmark.outcome import write_outcome
from ljn.benchmark.predictors import LiftedKeypoints, entrant
from ljn.benchmark.real import RealBenchmark
from ljn.benchmark.store import Store
from ljn.body.skeleton import JOINT_INDEX

JOINTS = {"torso": "spine2", "l_hand": "l_wrist", "r_hand": "r_wrist"}


class Truthful:
    """Gives true joints, moved."""

    def __init__(self, samples, moved=(0.0, 0, 0)):
        self.joints = samples.truth([0]).joints[0] + np.float32(moved)
        self.seen = []

    def __call__(self, frames):
        self.seen += [frame.keypoints for frame in frames]
        return np.tile(self.joints, (len(frames), 1, 1))


def run(path, samples, tmp_path, *predictors, **settings):
    bench = RealBenchmark(path, samples, JOINTS, **settings)
    entrants = [entrant(each, f"p{number}", {"n": number}) for number, each in enumerate(predictors)]
    return bench.run(entrants, Store(tmp_path / "store"), lambda words: None)


def value(outcome, method, key="mean", labels="all", offset="none", joint="all"):
    wanted = {"labels": labels, "offset": offset, "joint": joint}
    [row] = [
        row
        for row in outcome.rows
        if row["method"].startswith(method) and all(row[name] == wanted[name] for name in wanted)
    ]
    return row[key]


def test_true_joints_have_no_error_and_others_their_own(frames_file, samples, tmp_path):
    outcome = run(frames_file(), samples, tmp_path, Truthful(samples), Truthful(samples, (0.03, 0, 0)))
    assert value(outcome, "p0, no") == pytest.approx(0, abs=1e-3)
    assert value(outcome, "p1, no") == pytest.approx(30, abs=1e-3)
    assert value(outcome, "p1, no", offset="fitted") == pytest.approx(0, abs=1e-3)
    assert value(outcome, "p1, no", joint="head") == pytest.approx(30, abs=1e-3)
    assert value(outcome, "other") == pytest.approx(50 * 3**0.5, abs=1e-3)
    assert value(outcome, "other", "under_10cm") == 100
    assert 0 < value(outcome, "lifted") < 400


def test_labels_that_are_not_on_the_person_are_left_out(frames_file, samples, tmp_path):
    labels = np.load(frames_file())["joints"].copy()
    labels[1, 2] += np.float32([0.0, 0, 1.5])
    outcome = run(frames_file(joints=labels), samples, tmp_path, Truthful(samples), person_m=0.2)
    assert value(outcome, "p0, no") == pytest.approx(1500 / 18, abs=1e-2)
    assert value(outcome, "p0, no", labels="on the person") == pytest.approx(0, abs=1e-3)
    assert value(outcome, "p0, no", "number", labels="on the person", joint="l_hand") < 3


def test_exchanged_sides_are_counted(frames_file, samples, tmp_path):
    labels = np.load(frames_file())["joints"].copy()
    labels[2] = labels[2][[0, 1, 3, 2, 5, 4]]
    outcome = run(frames_file(joints=labels), samples, tmp_path, Truthful(samples))
    assert outcome.sections[0].sheet.rows[0][-1].text == "1"


def test_keypoints_of_the_labels_are_those_of_single_joints(frames_file, samples, tmp_path):
    predictor = Truthful(samples)
    predictor.reads = ("keypoints",)
    run(frames_file(), samples, tmp_path, predictor)
    assert predictor.seen[:3] == [None] * 3
    known = {name for name, row in zip(JOINT_INDEX, predictor.seen[3]) if row[2] == 1}
    assert known == {"head", "spine2", "l_wrist", "r_wrist", "l_knee", "r_knee"}
    camera, joint = samples.camera(0), samples.truth([0]).joints[0, JOINT_INDEX["head"]]
    u = joint[0] / joint[2] * camera.fx + camera.cx
    assert predictor.seen[3][JOINT_INDEX["head"], 0] == pytest.approx(u, abs=1e-2)
    again = Truthful(samples)
    again.reads = ("keypoints",)
    run(frames_file(), samples, tmp_path, again)
    assert again.seen == []  # it was kept


def test_the_offset_is_that_of_the_synthetic_surface(samples):
    names = ("head", "l_hip")
    mapped = joint_map(names, {})
    flat = fit_offsets(samples, mapped, dict.fromkeys(names, 0.0))
    deep = fit_offsets(samples, mapped, dict.fromkeys(names, 0.05))
    assert (flat.metres[:, 2] < -0.02).all()  # the surface is before the joint
    assert (np.abs(flat.metres[:, :2]) < 0.06).all()
    moved = np.linalg.norm(deep.metres - flat.metres, axis=-1)
    assert (moved <= 0.05 + 1e-9).all()
    assert (moved > 0.04).all()  # along rays of several directions
    assert (flat.numbers <= (samples.facing() <= 45).sum()).all()
    with pytest.raises(ValueError, match=r"surface_depth_m: expected a depth of every label.*none of l_hip"):
        fit_offsets(samples, mapped, {"head": 0.0})


def test_the_fixed_offset_is_taken_off_predictors_of_joints_alone(frames_file, samples, tmp_path):
    depths = dict.fromkeys(("head", "torso", "l_hand", "r_hand", "l_knee", "r_knee"), 0.02)
    bench = RealBenchmark(frames_file(), samples, JOINTS, depths)
    offsets = fit_offsets(samples, bench.mapped, depths)
    outcome = run(
        frames_file(), samples, tmp_path, Truthful(samples), LiftedKeypoints(), surface_depth_m=depths
    )
    expected = 1000 * np.linalg.norm(offsets.metres, axis=-1).mean()
    assert value(outcome, "p0, no", offset="fixed") == pytest.approx(expected, abs=1e-3)
    for method in ("lifted:", "other", "lifted keypoints, keypoints"):
        assert value(outcome, method, offset="fixed") == ""
    assert outcome.sections[-1].name == "offsets"


def test_a_list_of_joints_is_their_mean_and_sides_have_counterparts():
    mapped = joint_map(("neck", "l_hand", "r_hand"), {**JOINTS, "neck": ["l_shoulder", "r_shoulder"]})
    joints = np.arange(72.0).reshape(24, 3)
    np.testing.assert_allclose(mapped(joints)[0], joints[[16, 17]].mean(0))
    assert mapped.mirror == [0, 2, 1]
    with pytest.raises(
        ValueError, match=r"label 'nose' is not known; known are torso, .*add bench\.joints\.nose="
    ):
        joint_map(("nose",), JOINTS)
    for wrong in ("snout", ["head", "snout"], [], 3):
        with pytest.raises(ValueError, match=r"bench\.joints\.nose: expected one of SMPL's joints"):
            joint_map(("nose",), {"nose": wrong})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mask": None}, "lacks mask; it has K, depth_m, joints, names, other"),
        (
            {"depth_m": np.zeros((3, 4))},
            r"depth_m: expected numbers of shape \(N, H, W\), got float64 of \(3, 4\)",
        ),
        ({"K": np.ones(3)}, r"K: expected numbers of shape \(4\)"),
        ({"K": np.array([1, 1, 1, np.nan])}, "K: 1 values are NaN or infinite"),
        ({"K": np.array([100.0, 100, -5, 3])}, "camera: the principal point"),
        (
            {"joints": np.ones((3, 5, 3))},
            r"joints: expected numbers of shape \(3, 6, 3\), got float64 of \(3, 5, 3\)",
        ),
        ({"joints": np.zeros((3, 6, 3))}, "joints: expected labels before the camera"),
        ({"names": np.arange(6)}, "names: expected a different text for each joint"),
        ({"names": np.array(["head"] * 6)}, "names: expected a different text for each joint"),
        ({"names": np.array(["a", None], object)}, "cannot be read .it holds object of shape"),
    ],
)
def test_a_wrong_array_is_named(changes, message, frames_file):
    with pytest.raises(ValueError, match=message):
        read_labelled_frames(frames_file(**changes))


def test_a_wrong_depth_or_mask_is_named(frames_file):
    with np.load(frames_file()) as arrays:
        depth, mask = arrays["depth_m"], arrays["mask"]
    for changes, message in (
        ({"depth_m": depth * 1000}, "depth_m: expected metres of 0 or more"),
        ({"depth_m": -depth}, "depth_m: expected metres of 0 or more"),
        ({"depth_m": np.where(depth > 0, np.nan, 0)}, "depth_m: .* values are NaN"),
        ({"mask": mask[:, 1:]}, "mask: expected truth values of depth_m's shape"),
        (
            {"mask": mask & (np.arange(3) != 1)[:, None, None]},
            r"mask: no pixel of the mask has a depth in frame 1",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            read_labelled_frames(frames_file(**changes))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"bench\.path: expected a file of real frames, got null"):
        read_labelled_frames(None)
    with pytest.raises(FileNotFoundError, match=r"bench\.path: no file"):
        read_labelled_frames(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match=r"bad\.npz' cannot be read"):
        read_labelled_frames(tmp_path / "bad.npz")


def test_a_predictor_that_fails_is_named_and_all_else_written(frames_file, samples, tmp_path):
    class Failing:
        name = "failing"

        def __call__(self, frames):
            raise KeyError("no such thing")

    outcome = run(frames_file(), samples, tmp_path, Failing(), Truthful(samples))
    assert outcome.failures == [
        "failing, no keypoints: predictor 'failing', sample 0: KeyError: 'no such thing'"
    ]
    text = write_outcome(tmp_path / "out", outcome, "")
    assert "FAILED" in text
    assert "p1, no keypoints" in text
    assert "<svg" in (tmp_path / "out" / "index.html").read_text()
