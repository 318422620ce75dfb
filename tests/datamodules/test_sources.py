import json

import numpy as np
import pytest
import torch

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.embedded import EmbeddedSource, without_heading
from ljn.body import GENDERS, SMPL
from ljn.body.skeleton import MIRROR, NUM_JOINTS
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat, smpl_pose_to_body_world

MIRROR_Y = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)


def some_poses(number=6, seed=0):
    return 0.5 * np.random.default_rng(seed).standard_normal((number, 72))


@pytest.fixture
def write_source(tmp_path):
    """Builds a source from poses, their clips, and a split given as a dict or as the file's text."""

    def write(poses=None, clip=None, split=None, **settings):
        poses = some_poses() if poses is None else poses
        clip = np.array(["a", "b", "c"] * (len(poses) // 3)) if clip is None else clip
        np.savez(tmp_path / "poses.npz", poses=poses, clip=clip)
        split = {"train": ["a"], "val": ["b"], "test": ["c"]} if split is None else split
        (tmp_path / "split.json").write_text(split if isinstance(split, str) else json.dumps(split))
        return EmbeddedSource(path=tmp_path / "poses.npz", split_path=tmp_path / "split.json", **settings)

    return write


def make_records(**changes):
    columns = {
        "pose": np.zeros((3, 72), np.float32),
        "betas": np.zeros((3, 10), np.float32),
        "gender": np.zeros(3, np.int64),
        "sequence": np.array(["walk", "run", "run"]),
        "frame": np.arange(3),
        "has_heading": True,
    }
    return PoseRecords(**{**columns, **changes})


# The table of records


def test_a_table_of_records_has_its_number_of_rows_as_length():
    assert len(make_records()) == 3


@pytest.mark.parametrize("name", ["betas", "gender", "sequence", "frame"])
def test_columns_of_other_lengths_are_an_error(name):
    column = getattr(make_records(), name)
    with pytest.raises(ValueError, match=rf"{name}: expected shape .* with R = 3, got \(2"):
        make_records(**{name: column[:2]})


def test_a_pose_of_another_width_is_an_error():
    with pytest.raises(ValueError, match=r"pose: expected shape \('R', 72\) with R = 3, got \(3, 66\)"):
        make_records(pose=np.zeros((3, 66), np.float32))


@pytest.mark.parametrize("name", ["pose", "betas"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_an_error_that_names_the_record(name, value):
    column = getattr(make_records(), name).copy()
    column[1:, 4] = value
    message = f"{name}: NaN or infinite values in 2 of 3 records, the first in record 1 .sequence 'run'"
    with pytest.raises(ValueError, match=message):
        make_records(**{name: column})


# What the embedded source yields


@pytest.mark.parametrize("split", SPLITS)
def test_records_are_complete_and_finite(source, split):
    records = source.records(split, 50, seed=0)
    assert len(records) == 50
    assert records.pose.dtype == records.betas.dtype == np.float32
    assert (records.gender == GENDERS["neutral"]).all()
    assert not records.has_heading


def test_splits_share_no_clip_and_leave_none_out(source):
    clips = {split: set(source.records(split, 1000, seed=0).sequence.tolist()) for split in SPLITS}
    for split in SPLITS:
        assert clips[split] == set(source._split[split])
    assert sum(map(len, clips.values())) == len(set.union(*clips.values()))
    assert set.union(*clips.values()) <= set(source._clips[1].tolist())


def test_the_same_seed_gives_the_same_records_and_another_seed_others(source):
    first, again, other = (EmbeddedSource().records("train", 40, seed) for seed in (3, 3, 4))
    for name in ("pose", "betas", "sequence", "frame"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert (getattr(first, name) != getattr(other, name)).any()


def test_splits_of_one_seed_draw_differently(source):
    assert (source.records("val", 20, 0).betas != source.records("test", 20, 0).betas).all()


def test_longer_clips_come_more_often_by_the_square_root_of_their_length(write_source):
    clip = np.array(["a"] * 25 + ["d"] * 100 + ["b", "c"])
    split = {"train": ["a", "d"], "val": ["b"], "test": ["c"]}
    sequence = write_source(some_poses(127), clip, split).records("train", 2000, 0).sequence
    assert (sequence == "d").mean() == pytest.approx(2 / 3, abs=0.03)


def test_frames_of_a_clip_come_equally_often(write_source):
    clip = np.array(["a"] * 10 + ["b", "c"])
    records = write_source(some_poses(12), clip).records("train", 2000, 0)
    np.testing.assert_allclose(np.bincount(records.frame, minlength=10) / 2000, 0.1, atol=0.025)


def test_a_record_is_the_frame_that_it_names_up_to_mirror_and_heading(write_source):
    poses = some_poses(9)
    source = write_source(poses, np.array(["a"] * 7 + ["b", "c"]), jitter_deg=0)
    records = source.records("train", 30, 0)
    plain = torch.from_numpy(poses).float().double()[records.frame]
    mirrored = plain.unflatten(-1, (24, 3))[:, list(MIRROR)] * torch.tensor([1.0, -1.0, -1.0])
    plain, mirrored = (
        without_heading(smpl_pose_to_body_world(pose)).float().numpy()
        for pose in (plain, mirrored.flatten(1))
    )
    is_plain = np.abs(records.pose - plain).max(1) < 1e-5
    is_mirrored = np.abs(records.pose - mirrored).max(1) < 1e-5
    assert (is_plain ^ is_mirrored).all()
    assert 5 < is_plain.sum() < 25


def test_mirrored_poses_are_exact_mirror_images(write_source, body):
    # Records of one frame without jitter: the pose, and its mirror image across the plane y = 0.
    source = write_source(some_poses(3, seed=7), jitter_deg=0)
    poses = np.unique(source.records("train", 20, 0).pose.round(6), axis=0)
    assert len(poses) == 2
    layer = SMPL(body).double()  # the body itself is symmetric
    output = layer(torch.from_numpy(poses).double(), torch.zeros(2, 10, dtype=torch.float64))
    joints, vertices = (points - output.joints[:, :1] for points in (output.joints, output.vertices))
    one, other = joints
    torch.testing.assert_close(one[list(MIRROR)] * MIRROR_Y, other, atol=1e-5, rtol=0)
    assert (one - other).abs().max() > 0.05
    # Meshes: each vertex has its mirrored partner.
    one, other = vertices
    assert torch.cdist(one[::50] * MIRROR_Y, other).amin(1).max() < 1e-3


def test_about_half_of_the_records_are_mirrored(write_source):
    poses = write_source(jitter_deg=0).records("train", 1000, 0).pose.round(4)
    frames_and_mirrors, counts = np.unique(poses, axis=0, return_counts=True)
    assert len(frames_and_mirrors) == 4  # two frames in the clip
    np.testing.assert_allclose(counts / 1000, 0.25, atol=0.05)


def test_jitter_turns_every_joint_but_the_root_by_its_standard_deviation(write_source):
    poses = some_poses(3)
    still = write_source(poses, jitter_deg=0).records("train", 500, 0).pose.reshape(-1, NUM_JOINTS, 3)
    moved = write_source(poses, jitter_deg=4).records("train", 500, 0).pose.reshape(-1, NUM_JOINTS, 3)
    relative = rotvec_to_rotmat(torch.from_numpy(still)).mT @ rotvec_to_rotmat(torch.from_numpy(moved))
    turn = np.rad2deg(rotmat_to_rotvec(relative).numpy())
    assert np.abs(turn[:, 0]).max() < 1e-2
    np.testing.assert_allclose(turn[:, 1:].std(0), 4, atol=0.6)
    assert turn[:, 1:].std() == pytest.approx(4, rel=0.02)


def test_without_heading_faces_along_x(source):
    pose = torch.from_numpy(source.records("train", 100, 0).pose).double()
    turn = rotation_about("z", torch.linspace(-3, 3, 100, dtype=torch.float64))
    turned = torch.cat([rotmat_to_rotvec(turn @ rotvec_to_rotmat(pose[:, :3])), pose[:, 3:]], -1)
    for poses in (pose, without_heading(turned)):
        forward = rotvec_to_rotmat(poses[:, :3])[:, :, 2]  # the pelvis looks along z in SMPL's rest frame
        assert forward[:, 1].abs().max() < 1e-6
        assert (forward[:, 0] >= 0).all()
    torch.testing.assert_close(without_heading(turned), without_heading(pose))


def test_without_heading_keeps_pitch_roll_and_the_other_joints():
    upright = smpl_pose_to_body_world(torch.zeros(72, dtype=torch.float64))
    torch.testing.assert_close(without_heading(upright), upright)
    pose = torch.from_numpy(some_poses(4))
    assert torch.equal(without_heading(pose)[:, 3:], pose[:, 3:])
    up = rotvec_to_rotmat(pose[:, :3])[:, 2]
    torch.testing.assert_close(rotvec_to_rotmat(without_heading(pose)[:, :3])[:, 2], up)


@pytest.mark.parametrize("max_beta", [0.5, 2.0])
def test_shape_coefficients_are_normal_but_bounded(max_beta):
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    betas = EmbeddedSource(max_beta=max_beta).records("train", 500, 0).betas
    assert np.abs(betas).max() <= max_beta
    normal = stats.truncnorm(-max_beta, max_beta)
    assert stats.kstest(betas.ravel(), normal.cdf).pvalue > 0.01


def test_the_fingerprint_follows_files_and_settings(write_source):
    source = write_source()
    prints = [
        source.fingerprint,
        write_source(jitter_deg=3).fingerprint,
        write_source(max_beta=1).fingerprint,
    ]
    prints.append(write_source(some_poses(6, seed=1)).fingerprint)
    prints.append(write_source(split={"train": ["b"], "val": ["a"], "test": ["c"]}).fingerprint)
    assert len(set(prints)) == len(prints)
    assert write_source().fingerprint == prints[0]


# Errors


@pytest.mark.parametrize("max_beta", [0.0, -1.0])
def test_a_bound_that_no_shape_can_meet_is_an_error(max_beta):
    with pytest.raises(ValueError, match=f"max_beta: expected more than 0, got {max_beta}"):
        EmbeddedSource(max_beta=max_beta)


def test_an_unknown_split_is_an_error(source):
    with pytest.raises(ValueError, match="split: expected one of train, val, test, got 'dev'"):
        source.records("dev", 1, 0)


def test_a_missing_pose_file_is_an_error_that_says_how_to_do_without(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"poses: no file .*none\.npz; leave `path` out"):
        EmbeddedSource(path=tmp_path / "none.npz").check()


@pytest.mark.parametrize("content", [b"", b"not an archive", "cut", "changed", "array"])
def test_a_damaged_pose_file_is_an_error(source, tmp_path, content):
    whole = source.path.read_bytes()
    if content == "cut":
        content = whole[: len(whole) // 2]
    elif content == "changed":
        content = whole[:9000] + b"damage" + whole[9006:]
    if content == "array":
        with open(tmp_path / "poses.npz", "wb") as file:
            np.save(file, np.zeros((3, 72)))
    else:
        (tmp_path / "poses.npz").write_bytes(content)
    with pytest.raises(
        ValueError, match=r"poses: .*poses\.npz cannot be read .*expected an \.npz file with `poses`"
    ):
        EmbeddedSource(path=tmp_path / "poses.npz").check()


def test_a_pose_file_without_its_arrays_is_an_error(tmp_path):
    np.savez(tmp_path / "poses.npz", pose=np.zeros((3, 72)))
    with pytest.raises(ValueError, match=r"cannot be read .*poses.*expected an \.npz file with `poses`"):
        EmbeddedSource(path=tmp_path / "poses.npz").check()


@pytest.mark.parametrize("shape", [(6, 66), (6, 24, 3), (72,)])
def test_poses_of_another_shape_are_an_error(write_source, shape):
    with pytest.raises(ValueError, match=r"holds `poses` of shape .*expected \(N, 72\) axis-angle values"):
        write_source(np.zeros(shape), np.array(["a"] * 6)).check()


def test_clips_for_another_number_of_frames_are_an_error(write_source):
    with pytest.raises(ValueError, match=r"`clip` of \(5,\); expected"):
        write_source(some_poses(6), np.array(["a", "b", "c", "a", "b"])).check()


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_poses_that_are_not_finite_are_an_error(write_source, value):
    poses = some_poses()
    poses[2, 5] = value
    with pytest.raises(ValueError, match="holds NaN or infinite values; drop or repair those frames"):
        write_source(poses).check()


def test_a_missing_split_file_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"poses: no split file .*none\.json"):
        EmbeddedSource(split_path=tmp_path / "none.json").check()


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ("{", "is no JSON file"),
        ("[]", "must hold a list of clips for each of train, val, test"),
        ({"train": ["a"], "val": ["b"]}, "must hold a list of clips for each of train, val, test"),
        (
            {"train": ["a"], "val": ["b"], "test": "c"},
            "must hold a list of clips for each of train, val, test",
        ),
        ({"train": ["a"], "val": ["b"], "test": ["x"]}, r"unknown clips: \['x'\]"),
        ({"train": ["a"], "val": ["b"], "test": ["a"]}, r"clips named twice: \['a'\]"),
    ],
)
def test_a_bad_split_file_is_an_error_that_names_it(write_source, split, message):
    with pytest.raises(ValueError, match=rf"poses: .*split\.json .*{message}"):
        write_source(split=split).check()


def test_a_split_without_clips_has_no_records(write_source):
    source = write_source(split={"train": ["a", "b", "c"], "val": [], "test": []})
    assert len(source.records("train", 5, 0)) == 5
    with pytest.raises(ValueError, match=r"split: .*split\.json lists no clips for 'val'"):
        source.records("val", 5, 0)
