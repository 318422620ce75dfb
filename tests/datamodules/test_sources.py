import inspect
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded import mixture as mixture_module
from datamodules.sources.embedded.joint_limits import with_square_elbows, within_limits
from ljn.body import GENDERS, SMPL
from ljn.body.kinematics import mirror, without_heading
from ljn.body.skeleton import MIRROR, NUM_JOINTS, ROOT
from ljn.geometry.rotations import (
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    smpl_pose_to_body_world,
)

MIRROR_Y = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
STRATA = {"locomotion", "floor", "acrobatics", "upper body"}
CONFIG = Path(__file__).parents[2] / "conf/data/source/embedded.yaml"


def some_poses(number=6, seed=0):
    return 0.1 * np.random.default_rng(seed).standard_normal((number, 72))


def to_rotmat(poses):
    """Rotations `(n, 24, 3, 3)` of poses `(n, 72)`."""
    return rotvec_to_rotmat(torch.from_numpy(poses).double().unflatten(-1, (NUM_JOINTS, 3)))


def to_pose(rotmat):
    """Poses `(n, 72)` in body world, heading dropped, of rotations in SMPL's axes."""
    rotmat = rotmat.clone()
    rotmat[:, ROOT] = without_heading(rotmat[:, ROOT])
    return smpl_pose_to_body_world(rotmat_to_rotvec(rotmat).flatten(1)).numpy()


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


# The hash of a table


@pytest.mark.parametrize(
    "changes",
    [
        {"pose": np.eye(3, 72, dtype=np.float32)},
        {"betas": np.eye(3, 10, dtype=np.float32)},
        {"gender": np.array([0, 1, 0])},
        {"sequence": np.array(["walk", "walk", "run"])},
        {"sequence": np.array(["walk", "run", "run2"])},
        {"frame": np.array([0, 1, 3])},
        {"has_heading": False},
    ],
)
def test_the_hash_follows_every_column(changes):
    assert make_records(**changes).hash != make_records().hash


def test_the_hash_is_16_hex_digits_and_pinned():
    assert make_records().hash == make_records().hash == "99e0057c62471cf7"


def test_the_hash_follows_the_order_and_the_number_of_rows():
    records = make_records(pose=np.eye(3, 72, dtype=np.float32))
    columns = ("pose", "betas", "gender", "sequence", "frame")
    turned = {name: getattr(records, name)[::-1] for name in columns}
    shorter = {name: getattr(records, name)[:2] for name in columns}
    assert len({records.hash, make_records(**turned).hash, make_records(**shorter).hash}) == 3


def test_rounding_leaves_the_hash(source):
    records = source.records("train", 100, 0)
    noise = np.random.default_rng(0).uniform(-4e-6, 4e-6, records.pose.shape)
    columns = {name: getattr(records, name) for name in ("betas", "gender", "sequence", "frame")}
    for pose in (records.pose + noise.astype(np.float32), records.pose.astype(np.float64)):
        assert PoseRecords(pose=pose, **columns, has_heading=False).hash == records.hash
    changed = records.pose.copy()
    changed[50, 7] += 2e-5
    assert PoseRecords(pose=changed, **columns, has_heading=False).hash != records.hash


def test_minus_zero_and_other_widths_of_text_leave_the_hash():
    records = make_records(
        pose=-np.zeros((3, 72), np.float32), sequence=np.array(["walk", "run", "run"], "U40")
    )
    assert records.hash == make_records().hash


# What the embedded source yields


@pytest.mark.parametrize("split", SPLITS)
def test_records_are_complete_and_finite(source, split):
    records = source.records(split, 50, seed=0)
    assert len(records) == 50
    assert records.pose.dtype == records.betas.dtype == np.float32
    assert records.gender.dtype == records.frame.dtype == np.int64
    assert records.sequence.dtype.kind == "U"
    assert not records.has_heading


def donors_of(records):
    """The names of all clips that had a part in the records."""
    names = {
        name
        for sequence in records.sequence.tolist()
        for part in sequence.split("|")
        for name in part.split("+")
    }
    return {name for name in names if not name.startswith("proc/")}


def test_donors_stay_in_their_split(source):
    donors = {split: donors_of(source.records(split, 800, seed=0)) for split in SPLITS}
    for split in SPLITS:
        assert donors[split] == set(source._split[split])
    assert sum(map(len, donors.values())) == len(set.union(*donors.values()))


def test_the_embedded_split_uses_every_clip_and_every_stratum_in_each_split(source):
    table = json.loads(source.split_path.read_text())
    for split in SPLITS:
        assert set(table[split]) == STRATA
        assert all(table[split].values())
    assert {clip for split in SPLITS for clip in source._split[split]} == set(source._clips.clip.tolist())


def test_the_motion_of_the_splits_is_that_of_all_clips(source):
    motion = {split: source.motion(split) for split in SPLITS}
    assert [motion[split]["clips"] for split in SPLITS] == [13, 4, 5]
    assert sum(counts["frames"] for counts in motion.values()) == len(source._clips.clip) == 3625
    assert EmbeddedSource(shares={"procedural": 1, "whole": 0}).motion("train") == {"clips": 0, "frames": 0}


def test_the_same_seed_gives_the_same_records_and_another_seed_others(source):
    first, again, other = (EmbeddedSource().records("train", 150, seed) for seed in (3, 3, 4))
    for name in ("pose", "betas", "gender", "sequence", "frame"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert (getattr(first, name) != getattr(other, name)).any()
    assert first.hash == again.hash != other.hash


def test_a_longer_request_begins_with_the_shorter_one(source):
    short, long = (source.records("val", number, 1) for number in (130, 500))
    for name in ("pose", "betas", "gender", "sequence", "frame"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:130])
    assert len(np.unique(long.betas, axis=0)) == 500


def test_splits_of_one_seed_draw_differently_even_without_donors():
    source = EmbeddedSource(shares={"procedural": 1})
    val, test = (source.records(split, 50, 0) for split in ("val", "test"))
    assert (val.betas != test.betas).any(1).all()
    assert (val.pose != test.pose).any(1).all()


def test_no_records_are_an_empty_table(source):
    assert len(source.records("train", 0, 0)) == 0


def test_a_source_survives_pickling(source):
    copy = pickle.loads(pickle.dumps(source))
    assert copy.fingerprint == source.fingerprint
    assert copy.records("test", 20, 0).hash == source.records("test", 20, 0).hash


@pytest.mark.parametrize("split", SPLITS)
def test_no_record_reaches_into_itself_by_more_than_five_centimetres(source, split):
    rotmat = to_rotmat(source.records(split, 400, 0).pose)
    assert source.mixture.of(split).depth(rotmat).max() < 0.05 + 1e-4  # poses are rounded


def test_poses_stand_on_a_grid_that_rounding_cannot_leave(source):
    pose = source.records("train", 300, 0).pose.astype(np.float64)
    assert np.abs(pose - np.rint(pose * 1e5) / 1e5).max() < 3e-7  # float32


def test_whole_poses_are_the_frames_that_they_name_up_to_mirror_and_heading():
    source = EmbeddedSource(shares={"whole": 1}, jitter_deg=0, max_penetration_m=1)
    records = source.records("test", 200, 0)
    poses, clip = source._clips
    rows = [np.flatnonzero(clip == name)[frame] for name, frame in zip(records.sequence, records.frame)]
    frames = within_limits(with_square_elbows(to_rotmat(poses[rows])))
    found = to_rotmat(records.pose)
    expected = [to_rotmat(to_pose(rotmat)) for rotmat in (frames, mirror(frames))]
    is_plain, is_mirrored = ((found - other).abs().flatten(1).amax(1) < 1e-4 for other in expected)
    assert (is_plain | is_mirrored).all()
    assert 70 < is_plain.sum() < 130


def test_mirrored_poses_are_exact_mirror_images(write_source, body):
    # Records of one frame without jitter: the pose, and its mirror image across the plane y = 0.
    source = write_source(some_poses(3, seed=7), jitter_deg=0, shares={"whole": 1})
    poses = np.unique(source.records("train", 20, 0).pose.round(6), axis=0)
    assert len(poses) == 2
    layer = SMPL(body).double()  # the body itself is symmetric
    output = layer(torch.from_numpy(poses).double(), torch.zeros(2, 10, dtype=torch.float64))
    joints, vertices = (points - output.joints[:, :1] for points in (output.joints, output.vertices))
    one, other = joints
    torch.testing.assert_close(one[list(MIRROR)] * MIRROR_Y, other, atol=5e-5, rtol=0)
    assert (one - other).abs().max() > 0.02
    # Meshes: each vertex has its mirrored partner.
    one, other = vertices
    assert torch.cdist(one[::50] * MIRROR_Y, other).amin(1).max() < 1e-3


def test_more_jitter_scatters_more(write_source):
    deviations = []
    for jitter_deg in (0, 2, 4):
        source = write_source(some_poses(3), jitter_deg=jitter_deg, shares={"whole": 1})
        rotmat = to_rotmat(source.records("train", 400, 0).pose)
        one, other = rotmat[::2], rotmat[1::2]
        deviations.append(rotmat_to_rotvec(one.mT @ other)[:, 3:].norm(dim=-1).median().item())
    assert deviations[0] < deviations[1] < deviations[2]


@pytest.mark.parametrize("genders", [("female", "male"), ("neutral",), ("male", "neutral", "female")])
def test_genders_come_equally_often(genders):
    gender = EmbeddedSource(genders=genders).records("train", 380, 0).gender
    for name in genders:
        assert (gender == GENDERS[name]).mean() == pytest.approx(1 / len(genders), abs=0.08)


def test_shapes_do_not_depend_on_how_poses_are_made():
    one, other = (
        EmbeddedSource(shares={kind: 1}).records("train", 50, 0) for kind in ("whole", "procedural")
    )
    np.testing.assert_array_equal(one.betas, other.betas)
    np.testing.assert_array_equal(one.gender, other.gender)


@pytest.mark.parametrize("max_beta", [0.5, 2.0])
def test_shape_coefficients_are_normal_but_bounded(max_beta):
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    betas = EmbeddedSource(max_beta=max_beta).records("train", 500, 0).betas
    assert np.abs(betas).max() <= max_beta
    normal = stats.truncnorm(-max_beta, max_beta)
    assert stats.kstest(betas.ravel(), normal.cdf).pvalue > 0.01


def test_the_fingerprint_follows_files_settings_body_and_version(write_source, monkeypatch):
    def prints():
        yield write_source().fingerprint
        for changes in (
            {"jitter_deg": 3},
            {"max_beta": 1},
            {"genders": ("female",)},
            {"shares": {"whole": 1}},
            {"families": {"walk": 1}},
            {"blend_share": 0.1},
            {"apart_share": 0.1},
            {"max_penetration_m": 0.04},
        ):
            yield write_source(**changes).fingerprint
        yield write_source(some_poses(6, seed=1)).fingerprint
        yield write_source(split={"train": ["b"], "val": ["a"], "test": ["c"]}).fingerprint
        source = write_source()
        source.__dict__["_body"] = type("Body", (), {"hash": "other"})
        yield source.fingerprint
        monkeypatch.setattr(EmbeddedSource, "version", -1)
        yield write_source().fingerprint

    found = list(prints())
    assert len(set(found)) == len(found)
    monkeypatch.undo()
    assert write_source().fingerprint == found[0]


def test_every_setting_is_in_the_fingerprint():
    # Whoever adds an argument adds it to the test above.
    assert set(inspect.signature(EmbeddedSource).parameters) == {
        "jitter_deg", "max_beta", "genders", "path", "split_path",
        "shares", "families", "blend_share", "apart_share", "max_penetration_m",
    }  # fmt: skip


def test_the_config_file_holds_the_defaults():
    config = OmegaConf.to_container(OmegaConf.load(CONFIG), resolve=False)
    for name, parameter in inspect.signature(EmbeddedSource).parameters.items():
        if name != "genders":  # the body's
            assert config[name] == (
                dict(parameter.default) if isinstance(config[name], dict) else parameter.default
            )
    assert list(config["shares"]) == list(mixture_module.KINDS)


# Errors


@pytest.mark.parametrize("max_beta", [0.0, -1.0])
def test_a_bound_that_no_shape_can_meet_is_an_error(max_beta):
    with pytest.raises(ValueError, match=f"max_beta: expected more than 0, got {max_beta}"):
        EmbeddedSource(max_beta=max_beta)


@pytest.mark.parametrize("genders", [(), ("female", "other")])
def test_genders_that_there_are_not_are_an_error(genders):
    with pytest.raises(ValueError, match=r"genders: expected some of female, male, neutral, got \["):
        EmbeddedSource(genders=genders)


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
        ("[]", "must hold a list of clips, or strata with such lists, for each of train, val, test"),
        (
            {"train": ["a"], "val": ["b"]},
            "must hold a list of clips, or strata with such lists, for each of train, val, test",
        ),
        (
            {"train": ["a"], "val": ["b"], "test": "c"},
            "must hold a list of clips, or strata with such lists, for each of train, val, test",
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
    with pytest.raises(ValueError, match="split: the table of splits lists no clips for 'val'"):
        source.records("val", 5, 0)
