import numpy as np
import pytest
import torch

from datamodules.sources.amass import AmassSource
from datamodules.sources.bvh import BvhSource
from ljn import SMPL
from ljn.body.skeleton import JOINT_NAMES, ROOT
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.pipeline.motion import PosedFrame, body_motion, shape_distance_mm, write_amass, write_bvh
from ljn.pipeline.prediction import Prediction

RATE_HZ = 25


@pytest.fixture(scope="module")
def layer(body):
    return SMPL(body)


@pytest.fixture(scope="module")
def frames(layer):
    """What is predicted of 12 frames of a person, whose shape is the same in each."""
    rng = np.random.default_rng(0)
    pose = (0.4 * rng.standard_normal((12, 72))).astype(np.float32)
    betas = np.tile(rng.standard_normal(10).astype(np.float32), (12, 1))
    joints = layer(torch.from_numpy(pose), torch.from_numpy(betas)).joints @ CAMERA_FROM_BODY.T.float()
    joints = joints - joints[:, :1] + torch.tensor([0.1, 0.2, 2.5]) + 0.1 * torch.arange(12)[:, None, None]
    return [PosedFrame(*values) for values in zip(pose, betas, joints.numpy())]


@pytest.fixture(scope="module")
def motion(frames, layer):
    return body_motion(frames, layer, RATE_HZ)


@pytest.fixture(scope="module")
def expected(frames):
    """The predicted joints `(12, 24, 3)`, metres, body world."""
    return np.array([frame.joints for frame in frames], np.float64) @ CAMERA_FROM_BODY.numpy()


def test_a_motion_has_the_joints_that_were_predicted(frames, motion, expected):
    np.testing.assert_allclose(motion.joints, expected, atol=1e-5)
    assert shape_distance_mm(frames, motion) < 0.01
    assert motion.gender == "neutral"


def test_frames_that_failed_stay_as_the_one_before(frames, layer, motion):
    gaps = [None, frames[0], None, *frames[1:3], None]
    held = body_motion(gaps, layer, RATE_HZ)
    np.testing.assert_array_equal(held.pose, motion.pose[[0, 0, 0, 1, 2, 2]])
    np.testing.assert_array_equal(held.root, motion.root[[0, 0, 0, 1, 2, 2]])
    assert shape_distance_mm(gaps, held) < 0.01
    others = [frame._replace(joints=frame.joints * 1.1) for frame in frames]
    assert shape_distance_mm(others, body_motion(others, layer, RATE_HZ)) > 5
    with pytest.raises(ValueError, match="frames: expected at least one that was predicted, got none"):
        body_motion([None], layer, RATE_HZ)
    with pytest.raises(ValueError, match="rate_hz: expected frames a second, more than 0, got 0"):
        body_motion(frames, layer, 0)


def test_a_prediction_without_a_mesh_has_no_pose():
    with pytest.raises(ValueError, match="prediction: expected one with a mesh"):
        PosedFrame.of(Prediction(np.zeros((24, 3)), np.zeros((1, 6))))


def test_amass_s_form_gives_an_smpl_layer_the_predicted_joints(motion, layer, expected, tmp_path):
    write_amass(tmp_path / "a.npz", motion)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        shapes = {name: arrays[name].shape for name in arrays}
        found = dict(arrays)
    assert shapes == {
        "poses": (12, 156), "trans": (12, 3), "betas": (16,), "dmpls": (12, 8), "gender": (), "mocap_framerate": (),
    }  # fmt: skip
    assert (str(found["gender"]), float(found["mocap_framerate"])) == ("neutral", RATE_HZ)
    pose = torch.zeros(12, 72)
    pose[:, :66] = torch.from_numpy(found["poses"][:, :66])
    betas = torch.from_numpy(found["betas"][:10]).float().expand(12, 10)
    joints = layer(pose, betas).joints.numpy() + found["trans"][:, None]
    assert np.abs(joints - expected).max() < 1e-4


def test_our_own_readers_give_the_joints_again(motion, layer, expected, tmp_path):
    write_amass(tmp_path / "a.npz", motion)
    write_bvh(tmp_path / "a.bvh", motion)
    for source in (AmassSource(tmp_path / "a.npz"), BvhSource(tmp_path / "a.bvh")):
        recordings = source.recordings
        assert recordings.notes == {}
        betas = torch.from_numpy(motion.betas).float().expand(12, 10)
        joints = layer(torch.from_numpy(recordings.pose), betas).joints.numpy()
        np.testing.assert_allclose(joints - joints[:, :1], expected - expected[:, :1], atol=1e-4)
    assert AmassSource(tmp_path / "a.npz", rate_hz=5).recordings.frame.tolist() == [0, 5, 10]


def test_an_independent_reader_of_bvh_finds_the_predicted_joints(motion, expected, tmp_path):
    bvhio = pytest.importorskip("bvhio", reason="bvhio is not installed: pip install -e '.[dev]'")
    write_bvh(tmp_path / "a.bvh", motion)
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    found = np.zeros((12, 24, 3))
    for frame in range(12):
        root.loadPose(frame, recursive=True)
        for joint, _, _ in root.layout():
            if joint.Name in JOINT_NAMES:
                x, y, z = joint.PositionWorld
                found[frame, JOINT_NAMES.index(joint.Name)] = 0.01 * z, 0.01 * x, 0.01 * y
    assert np.abs(found).min(axis=(0, 2)).all(), "all joints are there"
    worst = np.linalg.norm(found - expected, axis=-1).max()
    assert worst < 1e-3, f"{1000 * worst:.3f} mm"
    print(f"the farthest joint is {1000 * worst:.4f} mm off")


def test_the_root_is_where_the_camera_saw_it(frames, motion):
    np.testing.assert_allclose(motion.root @ CAMERA_FROM_BODY.numpy().T, [f.joints[ROOT] for f in frames])


@pytest.mark.parametrize("write", [write_amass, write_bvh])
def test_arrays_that_make_no_motion_are_named(write, motion, tmp_path):
    for name, value in (("pose", motion.pose[:, :66]), ("root", np.full((12, 3), np.nan))):
        with pytest.raises(ValueError, match=rf"{name}: expected finite numbers of shape \(12, "):
            write(tmp_path / "a", motion._replace(**{name: value}))
    with pytest.raises(ValueError, match="pose: expected at least one frame, got none"):
        write(tmp_path / "a", motion._replace(pose=motion.pose[:0], root=motion.root[:0]))
