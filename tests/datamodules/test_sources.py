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
from ljn.body import GENDERS
from ljn.body.kinematics import mirror, without_heading
from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.geometry.rotations import (
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    smpl_pose_to_body_world,
)

COLUMNS = ("pose", "betas", "gender", "sequence", "frame")
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


@pytest.mark.parametrize("name", ["betas", "gender", "sequence", "frame"])
def test_columns_of_another_shape_are_an_error(name):
    column = getattr(make_records(), name)
    with pytest.raises(ValueError, match=rf"{name}: expected shape .* with R = 3, got \(2"):
        make_records(**{name: column[:2]})
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
def test_the_hash_follows_every_column_and_is_pinned(changes):
    assert make_records(**changes).hash != make_records().hash == "99e0057c62471cf7"


def test_the_hash_follows_the_order_and_the_number_of_rows():
    records = make_records(pose=np.eye(3, 72, dtype=np.float32))
    turned = {name: getattr(records, name)[::-1] for name in COLUMNS}
    shorter = {name: getattr(records, name)[:2] for name in COLUMNS}
    assert len({records.hash, make_records(**turned).hash, make_records(**shorter).hash}) == 3


def test_rounding_leaves_the_hash(source):
    records = source.records("train", 100, 0)
    exact = records.pose.astype(np.float64)
    assert np.abs(exact - np.rint(exact * 1e5) / 1e5).max() < 3e-7, "on a grid that rounding cannot leave"
    noise = np.random.default_rng(0).uniform(-4e-6, 4e-6, records.pose.shape)
    columns = {name: getattr(records, name) for name in COLUMNS[1:]}
    for pose in (records.pose + noise.astype(np.float32), exact):
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
    assert sum(map(len, donors.values())) == len(set(source._clips.clip.tolist())), "every clip once"
    table = json.loads(source.split_path.read_text())
    for split in SPLITS:
        assert set(table[split]) == STRATA
        assert all(table[split].values())


def test_the_motion_of_the_splits_is_that_of_all_clips(source):
    motion = {split: source.motion(split) for split in SPLITS}
    assert [motion[split]["clips"] for split in SPLITS] == [13, 4, 5]
    assert sum(counts["frames"] for counts in motion.values()) == len(source._clips.clip) == 3625
    assert EmbeddedSource(shares={"procedural": 1, "whole": 0}).motion("train") == {"clips": 0, "frames": 0}


def test_the_same_seed_gives_the_same_records_and_another_seed_others(source):
    first, again, other = (EmbeddedSource().records("train", 150, seed) for seed in (3, 3, 4))
    assert first.pose.dtype == first.betas.dtype == np.float32
    assert first.gender.dtype == first.frame.dtype == np.int64
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        assert (getattr(first, name) != getattr(other, name)).any()
    assert first.hash == again.hash != other.hash


def test_a_longer_request_begins_with_the_shorter_one(source):
    short, long = (source.records("val", number, 1) for number in (130, 500))
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:130])
    assert len(np.unique(long.betas, axis=0)) == 500
    assert len(source.records("val", 0, 1)) == 0


def test_splits_of_one_seed_draw_differently_even_without_donors():
    source = EmbeddedSource(shares={"procedural": 1})
    val, test = (source.records(split, 50, 0) for split in ("val", "test"))
    assert (val.betas != test.betas).any(1).all()
    assert (val.pose != test.pose).any(1).all()


def test_a_source_survives_pickling(source):
    copy = pickle.loads(pickle.dumps(source))
    assert copy.fingerprint == source.fingerprint
    assert copy.records("test", 20, 0).hash == source.records("test", 20, 0).hash


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
        changes = {
            "jitter_deg": 3, "max_beta": 1, "genders": ("female",), "shares": {"whole": 1}, "families": {"walk": 1},
            "blend_share": 0.1, "apart_share": 0.1, "max_penetration_m": 0.04,
        }  # fmt: skip
        # A new setting fails the test until it stands here.
        assert inspect.signature(EmbeddedSource).parameters.keys() == {"path", "split_path", *changes}
        for name, value in changes.items():
            yield write_source(**{name: value}).fingerprint
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


def test_the_config_file_holds_the_defaults():
    config = OmegaConf.to_container(OmegaConf.load(CONFIG), resolve=False)
    for name, parameter in inspect.signature(EmbeddedSource).parameters.items():
        if name != "genders":  # the body's
            assert config[name] == (
                dict(parameter.default) if isinstance(config[name], dict) else parameter.default
            )
    assert list(config["shares"]) == list(mixture_module.KINDS)


# Errors


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_beta": 0.0}, r"max_beta: expected more than 0, got 0\.0"),
        ({"genders": ()}, r"genders: expected some of female, male, neutral, got \["),
        ({"genders": ("female", "other")}, r"genders: expected some of female, male, neutral, got \["),
    ],
)
def test_settings_that_make_no_sense_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        EmbeddedSource(**settings)


def test_an_unknown_split_and_missing_files_are_named(source, tmp_path):
    with pytest.raises(ValueError, match="split: expected one of train, val, test, got 'dev'"):
        source.records("dev", 1, 0)
    with pytest.raises(FileNotFoundError, match=r"poses: no file .*none\.npz; leave `path` out"):
        EmbeddedSource(path=tmp_path / "none.npz").check()
    with pytest.raises(
        FileNotFoundError, match=r"poses: no file .*name the kind of your data \(data/source=amass"
    ):
        EmbeddedSource(path=tmp_path).check()
    with pytest.raises(FileNotFoundError, match=r"poses: no split file .*none\.json"):
        EmbeddedSource(split_path=tmp_path / "none.json").check()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda whole: whole[: len(whole) // 2], "cannot be read .*expected an .npz file with `poses`"),
        (lambda whole: whole[:9000] + b"damage" + whole[9006:], "cannot be read .*expected an .npz file with"),
        ({"pose": np.zeros((3, 72))}, "cannot be read .*poses.*expected an .npz file with `poses`"),
        ({"poses": np.zeros((6, 66)), "clip": ["a"] * 6}, r"holds `poses` of shape .*expected \(N, 72\) axis-angle"),
        ({"poses": np.zeros((6, 24, 3)), "clip": ["a"] * 6}, r"holds `poses` of shape .*expected \(N, 72\)"),
        ({"poses": some_poses(), "clip": ["a"] * 5}, r"`clip` of \(5,\); expected"),
        ({"poses": np.full((6, 72), -np.inf), "clip": ["a"] * 6}, "holds NaN or infinite values; drop or repair"),
    ],
)  # fmt: skip
def test_a_bad_pose_file_is_named(source, content, message, tmp_path):
    path = tmp_path / "poses.npz"
    np.savez(path, **content) if isinstance(content, dict) else path.write_bytes(
        content(source.path.read_bytes())
    )
    with pytest.raises(ValueError, match=rf"poses: .*poses\.npz.*{message}"):
        EmbeddedSource(path=path).check()


@pytest.mark.parametrize(
    ("split", "message"),
    [
        ("{", "is no JSON file"),
        ("[]", "must hold a list of clips, or strata with such lists, for each of train, val, test"),
        ({"train": ["a"], "val": ["b"]}, "must hold a list of clips"),
        ({"train": ["a"], "val": ["b"], "test": "c"}, "must hold a list of clips"),
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
