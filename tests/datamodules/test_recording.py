from itertools import islice

import numpy as np
import pytest
import torch

from datamodules.recording import Curtain, SyntheticRecording, write_recording
from datamodules.recording.motion import embedded_motion
from ljn.body import SMPL, load_body_model
from ljn.geometry.camera import Camera, project
from ljn.system.readers import open_recording
from ljn.system.segmentation import GreenCurtain

SMALL = Camera(120, 120, 79.5, 69.5, 160, 140)


def recording(**changes):
    arguments = {"clip_frames": 4, "camera": SMALL, "curtain": Curtain(), "sway_m": 0.1}
    return SyntheticRecording(**{**arguments, **changes})


@pytest.fixture(scope="module")
def plain():
    return recording()


def test_frames_are_of_one_scene_and_the_person_is_before_it(plain):
    frames = list(plain.frames(1))
    assert [frame.number for frame in frames] == [1, 2, 3]
    assert frames[0].timestamp_s == pytest.approx(1 / 30)
    empty = plain.empty_frame()
    for frame in frames:
        assert frame.depth.shape == (140, 160)
        assert frame.depth.dtype == np.float32
        assert frame.rgb.dtype == np.uint8
        mask = plain.truth(frame.number).mask
        assert 500 < np.count_nonzero(mask) < 6000
        assert not mask[[0, -1]].any()
        assert np.array_equal(frame.depth[~mask], empty.depth[~mask])
        assert (frame.depth[mask] < empty.depth[mask]).all()
    assert empty.depth[:50, 60:100].min() > frame.depth[mask].max()


def test_the_truth_is_one_body_in_the_cameras_frame(plain):
    truth = plain.truth(2)
    body = SMPL([load_body_model(gender="female")]).double()
    pose = torch.from_numpy(np.concatenate([truth.global_orient, truth.pose[3:]])).double()
    with torch.no_grad():
        vertices, joints = body(pose[None], torch.from_numpy(truth.betas).double()[None])
    assert np.allclose(vertices[0].numpy() + truth.transl, truth.vertices, atol=1e-4)
    assert np.allclose(joints[0].numpy() + truth.transl, truth.joints, atol=1e-4)
    seen = project(torch.from_numpy(truth.joints), SMALL.intrinsics())
    assert np.allclose(seen, truth.keypoints, atol=1e-3)
    assert truth.vertices[:, 1].max() == pytest.approx(plain.floor_m, abs=1e-4)
    u, v = np.rint(truth.keypoints[0]).astype(int)
    assert truth.mask[v, u]


def test_a_frame_depends_on_its_number_alone_and_the_clip_runs_back_and_forth(plain):
    again = recording(num_frames=12)
    assert len(list(islice(again.frames(), 20))) == 12
    assert np.array_equal(again.frame(3).rgb, plain.frame(3).rgb)
    assert np.array_equal(again.truth(3).pose, again.truth(9).pose)
    assert not np.array_equal(again.truth(3).joints, again.truth(9).joints)  # it wanders
    with pytest.raises(ValueError, match="number: expected a frame from 0 to 11"):
        again.frame(12)
    assert not np.array_equal(recording(seed=4).frame(3).rgb, plain.frame(3).rgb)


def test_the_curtain_is_green_and_its_light_falls_on_the_person(plain):
    frame, empty = plain.frame(0), plain.empty_frame()
    red, green, blue = empty.rgb[20:60, 60:100].reshape(-1, 3).mean(0)
    assert green > 1.5 * max(red, blue)
    mask = plain.truth(0).mask
    without = recording(curtain=Curtain(spill=0)).frame(0)
    excess = [image.rgb[mask].astype(float) @ (-0.5, 1, -0.5) for image in (frame, without)]
    assert excess[0].mean() > excess[1].mean() + 3
    bare = recording(curtain=None).empty_frame().rgb[20:60, 60:100].astype(float)
    assert np.ptp(bare.mean((0, 1))) < 40


def test_the_whole_clip_is_seen_whatever_the_distance():
    near = recording(distance_m=0.5, clip="humanoid3d_spin", clip_frames=None, sway_m=0.05)
    assert near._place[2] > 1
    for number in (0, 40, 80):
        assert not near.truth(number).mask[[0, -1]].any()
        assert not near.truth(number).mask[:, [0, -1]].any()


def test_the_first_frame_faces_where_it_is_told():
    for heading in (0, 90):
        pose = embedded_motion("01_01", 300, 2, heading).pose
        turned = embedded_motion("01_01", 300, 2, 0).pose
        assert pose.shape == (2, 72)
        assert np.allclose(pose[:, 3:], turned[:, 3:])
    facing = recording(clip="01_01", start=300).truth(0)
    left, right = facing.joints[16], facing.joints[17]
    assert left[0] > right[0]  # the person's left is at the image's right


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"clip": "humanoid3d_walk"},
            "clip: expected one of the test split's .*01_01.*, got 'humanoid3d_walk'",
        ),
        ({"start": 900}, "start: expected a frame of the clip 'humanoid3d_dance_b'"),
        ({"clip_frames": 0}, "num_frames of 1 or more"),
        ({"num_frames": 0}, "num_frames: expected 1 or more"),
        ({"distance_m": -1}, "distance_m: expected a number of more than 0"),
    ],
)
def test_wrong_arguments_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        recording(**changes)


def test_wrong_curtains_are_refused():
    with pytest.raises(ValueError, match=r"curtain.colour: expected three numbers in 0-1"):
        Curtain(colour=(10, 200, 30))
    with pytest.raises(ValueError, match=r"curtain.fold_m: expected a length of more than 0"):
        Curtain(fold_m=0)


def test_it_is_written_as_files_that_are_read_again(plain, tmp_path):
    write_recording(plain, tmp_path / "clip", 2)
    read = open_recording(tmp_path / "clip")
    assert read.num_frames == 2
    assert read.camera == SMALL
    for frame in read.frames():
        assert np.array_equal(frame.rgb, plain.frame(frame.number).rgb)
        assert np.abs(frame.depth - plain.frame(frame.number).depth).max() <= 0.00051
    with np.load(tmp_path / "clip" / "truth.npz") as truth:
        assert np.array_equal(truth["mask"][1], plain.truth(1).mask)
        assert truth["joints"].shape == (2, 24, 3)


@pytest.mark.slow
def test_the_noisy_curtain_as_configured_is_segmented(compose_config):
    from ljn.building import build

    noisy = build(compose_config("task=ar", "recording=synthetic").recording)
    assert len({noisy._look.colours.tobytes(), recording()._look.colours.tobytes()}) == 2
    values = []
    for number in range(0, noisy.num_frames, 25):
        mask, truth = GreenCurtain()(noisy.frame(number), noisy.camera), noisy.truth(number).mask
        values.append(np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth))
    assert np.mean(values) >= 0.97
