import re

import numpy as np
import pytest
import torch

from datamodules.sources.npz import NpzSource
from ljn.body import GENDERS
from ljn.geometry.rotations import smpl_pose_to_body_world

POSES = np.zeros((5, 72))


def recordings_of(path, settings=None, **fields):
    np.savez(path, **fields)
    return NpzSource(path, **(settings or {})).recordings


def test_a_round_trip_keeps_the_joints(some_poses, joints_of, tmp_path):
    poses = some_poses(30)
    world = smpl_pose_to_body_world(torch.from_numpy(poses)).numpy()
    betas = np.random.default_rng(0).standard_normal((30, 10))
    found = recordings_of(tmp_path / "a.npz", poses=poses, betas=betas, subject=np.array(["x", "y"] * 15))
    order = [*range(0, 30, 2), *range(1, 30, 2)]
    np.testing.assert_allclose(joints_of(found.pose), joints_of(world[order]), atol=1e-4)
    np.testing.assert_allclose(found.betas, betas[order], atol=1e-6)
    assert found.subjects == ("x", "y")
    as_is = recordings_of(tmp_path / "a.npz", {"up": "z"}, poses=world)
    np.testing.assert_allclose(as_is.pose, world, atol=1e-5)


def test_a_file_read_with_the_wrong_vertical_axis_is_doubted(tmp_path, caplog):
    subjects = np.array(list("abcde"))
    np.savez(
        tmp_path / "a.npz", poses=smpl_pose_to_body_world(torch.from_numpy(POSES)).numpy(), subject=subjects
    )
    NpzSource(tmp_path / "a.npz", up="z").check()
    assert not caplog.messages
    source = NpzSource(tmp_path / "a.npz")
    source.check()
    assert re.search(r"in 5 of 5 motions bodies do not stand, as in .*: .*data\.source\.up=z", caplog.text)
    assert source.motion("test")["lying_clips"] == 1


@pytest.mark.parametrize("shape", [(6, 24, 3), (6, 156), (6, 165), (6, 66), (6, 55, 3)])
def test_poses_of_other_bodies_and_shapes_are_taken(shape, tmp_path):
    assert recordings_of(tmp_path / "a.npz", poses=np.zeros(shape, np.float16)).pose.shape == (6, 72)


def test_clips_subjects_and_genders_come_from_their_fields(some_poses, tmp_path):
    found = recordings_of(
        tmp_path / "a.npz",
        poses=some_poses(4),
        clip=np.array([1, 0, 1, 1]),
        clips=np.array(["01_02", "07_01"]),
        gender=np.array("female"),
        betas=np.zeros(16),
        frame=np.array([5, 6, 9, 12]),
        frame_rate=30,
    )
    assert (found.clips, found.subjects) == (("07_01", "01_02"), ("07", "01"))
    assert found.frame.tolist() == [5, 9, 12, 6]
    assert found.clip.tolist() == [0, 0, 0, 1]
    assert set(found.gender) == {GENDERS["female"]}


def test_files_of_a_folder_have_its_subfolders_as_subjects(some_poses, tmp_path):
    for place in ("a/one.npz", "a/two.npz", "b/one.npz", "c_01.npz"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        np.savez(tmp_path / place, poses=some_poses(3))
    found = NpzSource(tmp_path).recordings
    assert found.clips == ("a/one", "a/two", "b/one", "c_01")
    assert found.subjects == ("a", "a", "b", "c")


SWUNG = np.tile(np.linspace(-1, 1, 72), (5, 1))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"poses": POSES, "clip": np.zeros(4)}, r"clip: expected one, or one for each of 5 poses, got \(4,"),
        ({"poses": POSES, "clip": np.arange(5), "clips": ["a"]}, "clip: expected numbers of the 1 `clips`"),
        ({"poses": POSES, "subject": np.zeros((5, 2))}, "subject: expected one, or one for each of 5"),
        ({"poses": POSES, "betas": np.zeros((4, 10))}, r"betas: expected shape \(B,\), or \(T, B\) with T = 5"),
        ({"poses": POSES, "betas": np.full(10, np.nan)}, "betas: NaN, or beyond 20 standard deviations"),
        ({"poses": POSES, "frame": np.zeros(5)}, "frame: expected whole numbers"),
        ({"poses": POSES, "gender": "x"}, "gender: expected one of female, male, neutral, got 'x'"),
        ({"poses": np.rad2deg(SWUNG)}, "rotations that no joint has in 5 of 5 frames; expected radians, not deg"),
        ({"poses": np.array(["a"])}, "poses: expected numbers, got <U1"),
        ({"poses": np.zeros((0, 72))}, "it holds no motion|poses: no frame"),
        ({"pose": POSES}, "poses: no such field in it"),
    ],
)  # fmt: skip
def test_a_wrong_field_is_named(fields, message, tmp_path):
    with pytest.raises(ValueError, match=rf"none of 1 files can be read; the first is a\.npz: .*{message}"):
        recordings_of(tmp_path / "a.npz", **fields)


def test_an_unknown_axis_is_named():
    with pytest.raises(ValueError, match="up: expected one of y, z, got 'x'"):
        NpzSource("a.npz", up="x")


def test_a_rate_that_cannot_be_kept_is_said(some_poses, tmp_path):
    np.savez(tmp_path / "a.npz", poses=some_poses(6), clip=np.repeat(["a_1", "b_1"], 3))
    assert NpzSource(tmp_path / "a.npz").recordings.notes == {}
    recordings = NpzSource(tmp_path / "a.npz", rate_hz=10).recordings
    assert recordings.notes == {"a.npz": ["frame_rate: missing, so all frames count"]}
