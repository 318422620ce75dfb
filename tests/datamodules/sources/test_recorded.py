import inspect
import logging
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from datamodules.sources import SPLITS
from datamodules.sources import recorded as recorded_module
from datamodules.sources.amass import AmassSource
from datamodules.sources.bvh import BvhSource
from datamodules.sources.filters import PoseFilters
from datamodules.sources.mixed import MixedSource
from datamodules.sources.npz import NpzSource
from datamodules.sources.subjects import read_splits, split_by_hash
from ljn.body import GENDERS
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat

CONF = Path(__file__).parents[3] / "conf/data/source"
COLUMNS = ("pose", "betas", "gender", "sequence", "frame")
SUBJECTS = [f"p{number:02d}" for number in range(20)]


@pytest.fixture(scope="module")
def poses_file(some_poses, tmp_path_factory):
    """Poses of 20 subjects, two clips of 30 frames each."""
    path = tmp_path_factory.mktemp("poses") / "poses.npz"
    clip = np.repeat([f"{subject}_{number}" for subject in SUBJECTS for number in range(2)], 30)
    np.savez(path, poses=some_poses(len(clip)), clip=clip)
    return path


def assert_equal(one, other, number=None):
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one, name)[:number], getattr(other, name)[:number])


# Records


def test_records_are_frames_of_their_split_each_once_before_any_twice(poses_file):
    source = NpzSource(poses_file)
    seen = {}
    for split in SPLITS:
        total = source.motion(split)["frames"]
        records = source.records(split, 2 * total + 7, 0)
        keys = list(zip(records.sequence.tolist(), records.frame.tolist()))
        assert len(set(keys[:total])) == total == len(set(keys[total : 2 * total]))
        assert keys[:total] != keys[total : 2 * total]
        seen[split] = {name.split("_")[0] for name in records.sequence.tolist()}
        table = {(name, frame): row for row, (name, frame) in enumerate(_keys(source.recordings))}
        rows = [table[key] for key in keys]
        np.testing.assert_array_equal(records.pose, source.recordings.pose[rows])
        assert records.has_heading
        assert set(records.kinds) == {"clip"}
    assert set.union(*seen.values()) == set(SUBJECTS)
    assert sum(map(len, seen.values())) == len(SUBJECTS), "disjoint"


def _keys(recordings):
    return zip(np.array(recordings.clips)[recordings.clip].tolist(), recordings.frame.tolist())


def test_a_longer_request_begins_with_the_shorter_one_and_seeds_differ(poses_file, monkeypatch):
    monkeypatch.setattr(recorded_module, "_BLOCK", 64)
    source = NpzSource(poses_file, max_heading_deg=90)
    long = source.records("train", 3000, 1)
    assert_equal(source.records("train", 150, 1), long, 150)
    assert_equal(pickle.loads(pickle.dumps(source)).records("train", 3000, 1), long)
    other = source.records("train", 150, 2)
    assert (other.betas != long.betas[:150]).any(1).all()
    assert len(source.records("train", 0, 1)) == 0


def test_shapes_and_genders_are_the_files_where_they_are_known(some_poses, tmp_path):
    betas = np.arange(30)[:, None] / 10 * np.ones(16)
    about = {
        "subject": np.repeat(["a", "b", "c"], 10),
        "gender": np.repeat(["female", "male", "neutral"], 10),
    }
    np.savez(tmp_path / "a.npz", poses=some_poses(30), betas=betas, **about)
    (tmp_path / "s.yaml").write_text("test: ['*']")
    source = NpzSource(tmp_path / "a.npz", splits=tmp_path / "s.yaml", genders=("female", "male"))
    records = source.records("test", 30, 0)
    expected = np.array([{"a": 0, "b": 10, "c": 20}[name] for name in records.sequence]) + records.frame
    np.testing.assert_allclose(records.betas[:, 0], expected / 10, atol=1e-6)
    is_of = {name: records.sequence == name for name in "abc"}
    assert set(records.gender[is_of["a"]]) == {GENDERS["female"]}
    assert set(records.gender[is_of["b"]]) == {GENDERS["male"]}
    assert set(records.gender[is_of["c"]]) == {GENDERS["female"], GENDERS["male"]}, "drawn"
    drawn = NpzSource(tmp_path / "a.npz", splits=tmp_path / "s.yaml", shapes="drawn").records("test", 30, 0)
    assert np.abs(drawn.betas).max() <= 3
    assert len(np.unique(drawn.betas, axis=0)) == 30


# Headings


def turned(pose, degrees):
    root = rotation_about("z", torch.tensor(np.deg2rad(degrees))) @ rotvec_to_rotmat(
        torch.from_numpy(pose[:, :3].astype(np.float64))
    )
    return np.concatenate([rotmat_to_rotvec(root).numpy(), pose[:, 3:]], 1)


def test_dropping_headings_undoes_a_turn_and_keeps_the_rest(poses_file):
    records = NpzSource(poses_file).records("train", 50, 0)
    bare = records.without_heading()
    assert bare.without_heading() is bare
    again = type(records)(turned(bare.pose, 130).astype(np.float32), *_others(records)).without_heading()
    found, expected = (rotvec_to_rotmat(torch.from_numpy(r.pose[:, :3])) for r in (again, bare))
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_array_equal(bare.pose[:, 3:], records.pose[:, 3:])
    assert not PoseFilters(max_heading_deg=0.1).takes(records.pose).all()
    assert PoseFilters(max_heading_deg=0.1).takes(bare.pose).all()


def _others(records):
    return (*(getattr(records, name) for name in COLUMNS[1:]), True)


def test_the_heading_setting_decides_whether_a_recorded_heading_stays(make_datamodule, poses_file):
    source = NpzSource(poses_file)
    records = source.records("train", 40, 0)
    for heading, expected in (("source", records), ("uniform", records.without_heading())):
        synthesizer = make_datamodule(source=source, heading=heading)._synthesizer("train")
        assert_equal(synthesizer.records, expected)


# Filters


def test_filters_keep_what_is_within_their_limits(real_poses, tmp_path):
    np.savez(tmp_path / "a.npz", poses=real_poses)
    (tmp_path / "s.yaml").write_text("test: ['*']")

    def number(**limits):
        source = NpzSource(tmp_path / "a.npz", splits=tmp_path / "s.yaml", **limits)
        return len(np.unique(source.records("test", 400, 0).pose, axis=0))

    assert number() == len(real_poses)
    standing, lying = (number(pelvis_height_m=heights) for heights in ([0.6, 2], [0, 0.6]))
    assert standing + lying == len(real_poses)
    assert 5 < lying < standing
    clear = number(max_penetration_m=0.02)
    assert 20 < clear < len(real_poses)
    assert clear < number(max_penetration_m=0.1)
    with pytest.raises(ValueError, match=r"none of the 158 test frames passes the filters .*allow more"):
        number(pelvis_height_m=[3, 4])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_heading_deg": -1}, "max_heading_deg: expected a number of 0 or more, or null, got -1"),
        ({"pelvis_height_m": [1]}, "pelvis_height_m: expected two numbers, lowest and highest"),
        ({"pelvis_height_m": [1, 0]}, "pelvis_height_m: expected two numbers, lowest and highest"),
        ({"max_penetration_m": float("nan")}, "max_penetration_m: expected a number of 0 or more"),
        ({"shapes": "none"}, "shapes: expected one of recorded, drawn, got 'none'"),
        ({"rate_hz": 0}, "rate_hz: expected frames a second, more than 0, or null, got 0"),
        ({"stride": 0.5}, r"stride: expected a whole number of 1 or more, got 0\.5"),
        ({"split_shares": [0.5, 0.5]}, "split_shares: expected shares of train, val, test"),
        ({"genders": []}, "genders: expected some of"),
    ],
)
def test_settings_that_make_no_sense_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        NpzSource("a.npz", **settings)


# Splits


def test_the_default_splits_hang_on_the_names_alone():
    shares = (0.8, 0.1, 0.1)
    names = SUBJECTS * 2
    splits = split_by_hash(names, shares)
    assert splits == split_by_hash(names[::-1], shares)
    assert [len(splits[split]) for split in SPLITS] == [16, 2, 2]
    assert [len(part) for part in split_by_hash("abc", shares).values()] == [1, 1, 1]
    assert [len(part) for part in split_by_hash("abcd", (0.1, 0.1, 0.8)).values()] == [1, 1, 2]
    with pytest.raises(ValueError, match=r"expected 3 subjects or more to split, got 2 .*splits=FILE\.yaml"):
        split_by_hash("ab", shares)


def test_a_file_says_which_split_is_whose(tmp_path):
    path = tmp_path / "splits.yaml"
    path.write_text("train: ['*/0*', KIT/9]\ntest: [CMU/01, 'KIT/1*']\n")
    names = ["CMU/01", "CMU/02", "CMU/03", "KIT/11", "KIT/9", "X/1"]
    splits = read_splits(path, names)
    assert splits == {"train": ("CMU/02", "CMU/03", "KIT/9"), "val": (), "test": ("CMU/01", "KIT/11")}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no YAML file"),
        ("[]", "expected lists of subjects under some of train, val, test, got"),
        ("dev: [a]", "expected lists of subjects under some of train, val, test, got"),
        ("test: a", "expected a list of subjects under test, got 'a'"),
        ("test: [x]", r"test names 'x', which no subject is; there are \['a', 'b'\]"),
        ("test: [a]\ntrain: [a]", r"a subject is in one split alone, but \['a'\] are in several"),
        ("test: ['*']\ntrain: ['a*']", r"a subject is in one split alone, but \['a'\] are in several"),
    ],
)
def test_a_bad_file_of_splits_is_named(text, message, tmp_path):
    (tmp_path / "splits.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"data\.source\.splits: .*splits\.yaml.*{message}"):
        read_splits(tmp_path / "splits.yaml", ["a", "b"])
    with pytest.raises(FileNotFoundError, match="no file nowhere"):
        read_splits(Path("nowhere"), ["a"])


def test_a_split_that_a_file_leaves_out_has_no_records(poses_file, tmp_path):
    (tmp_path / "s.yaml").write_text("test: ['p0*']")
    source = NpzSource(poses_file, splits=tmp_path / "s.yaml")
    motion = source.motion("test")
    assert motion.pop("lying_clips") in range(20)
    assert motion == {"subjects": 10, "clips": 20, "frames": 600, "skipped_files": 0}
    with pytest.raises(ValueError, match=r"split: .*s\.yaml lists no subjects for 'val'"):
        source.records("val", 1, 0)
    with pytest.raises(ValueError, match="split: expected one of train, val, test, got 'dev'"):
        source.records("dev", 1, 0)


# The table of frames


def test_files_are_read_once_and_again_when_they_change(
    poses_file, some_poses, tmp_path, monkeypatch, caplog
):
    path = tmp_path / "poses.npz"
    path.write_bytes(poses_file.read_bytes())

    def source(**settings):
        made = NpzSource(path, **settings)
        made.cache_dir = tmp_path / "cache"
        return made

    first = source()
    first.check()
    with monkeypatch.context() as patch, caplog.at_level(logging.INFO):
        patch.setattr(NpzSource, "read", None)
        again = source()
        assert again.fingerprint == first.fingerprint
        assert_equal(again.records("test", 50, 0), first.records("test", 50, 0))
        assert "1 of 1 files read, 40 motions of 20 subjects, 1200 frames" in caplog.text
    assert source(stride=2).fingerprint != first.fingerprint
    np.savez(path, poses=some_poses(60), subject=np.repeat(SUBJECTS[:4], 15))
    assert source().fingerprint != first.fingerprint


def test_the_fingerprint_follows_content_and_settings_but_no_place(poses_file, tmp_path):
    def prints():
        yield NpzSource(poses_file).fingerprint
        changes = {
            "split_shares": (0.6, 0.2, 0.2), "rate_hz": 5, "stride": 2, "shapes": "drawn", "max_beta": 1,
            "genders": ("male",), "max_heading_deg": 45, "pelvis_height_m": (0.5, 1), "max_penetration_m": 0.05,
        }  # fmt: skip
        known = inspect.signature(recorded_module.RecordedSource).parameters.keys()
        assert known == {"path", "splits", *changes}, "a new setting stands here, too"
        del changes["rate_hz"]  # the file does not say its rate
        for name, value in changes.items():
            yield NpzSource(poses_file, **{name: value}).fingerprint
        yield NpzSource(poses_file, up="z").fingerprint

    found = list(prints())
    assert len(set(found)) == len(found)
    copy = tmp_path / "elsewhere.npz"
    copy.write_bytes(poses_file.read_bytes())
    assert NpzSource(copy).fingerprint == found[0]


@pytest.mark.parametrize("source", [AmassSource, BvhSource, NpzSource])
def test_the_config_files_hold_the_defaults(source):
    config = OmegaConf.to_container(OmegaConf.load(CONF / f"{source.name}.yaml"), resolve=False)
    own = {"amass": {"rate_hz": 10}, "bvh": {"rate_hz": 10, "shapes": "drawn"}, "npz": {}}[source.name]
    parameters = {
        **inspect.signature(recorded_module.RecordedSource).parameters,
        **inspect.signature(source).parameters,
    }
    parameters.pop("settings", None)
    assert config.keys() - {"_target_", "_convert_"} == parameters.keys()
    for name, parameter in parameters.items():
        default = parameter.default
        if name != "genders":  # the body's
            expected = own.get(name, list(default) if isinstance(default, tuple) else default)
            assert config[name] == expected, name


# Mixed


def test_a_mixture_has_its_sources_records_by_their_weights(poses_file, source):
    recorded = NpzSource(poses_file)
    mixed = MixedSource(
        {"embedded": source, "npz": recorded, "bvh": BvhSource()}, {"embedded": 1, "npz": 3, "bvh": 0}
    )
    records = mixed.records("train", 400, 0)
    is_recorded = np.char.startswith(records.sequence, "p") & ~np.char.startswith(records.sequence, "proc")
    assert is_recorded.mean() == pytest.approx(0.75, abs=0.06)
    assert not records.has_heading
    alone = recorded.records("train", int(is_recorded.sum()), 0).without_heading()
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(records, name)[is_recorded], getattr(alone, name))
    generated = source.records("train", int((~is_recorded).sum()), 0)
    np.testing.assert_array_equal(records.pose[~is_recorded], generated.pose)
    assert_equal(mixed.records("train", 70, 0), records, 70)
    assert mixed.motion("train")["npz.frames"] == recorded.motion("train")["frames"]
    assert mixed.genders == ("female", "male")


def test_a_mixture_of_recorded_sources_keeps_headings(poses_file):
    parts = {"a": NpzSource(poses_file), "b": NpzSource(poses_file, genders=("neutral",))}
    mixed = MixedSource(parts, {"a": 1, "b": 1})
    assert mixed.records("val", 10, 0).has_heading
    assert mixed.genders == ("female", "male", "neutral")
    assert MixedSource(parts, {"a": 1, "b": 2}).fingerprint != mixed.fingerprint
    mixed.cache_dir = Path("cache")
    assert parts["b"].cache_dir == Path("cache")


def test_people_of_two_sources_in_different_splits_are_warned_of(some_poses, source, tmp_path, caplog):
    for name in ("01", "02", "03"):
        path = tmp_path / "AMASS/CMU" / name / "a_poses.npz"
        path.parent.mkdir(parents=True)
        np.savez(path, poses=some_poses(5))
    names = np.repeat(["01", "2", "3"], 5)
    np.savez(tmp_path / "plain.npz", poses=some_poses(15), subject=names)
    for name, table in {
        "one": "train: [CMU/01]\nval: [CMU/02]\ntest: [CMU/03]",
        "two": "train: ['01']\nval: ['3']\ntest: ['2']",
        "same": "train: ['01']\nval: ['2']\ntest: ['3']",
    }.items():
        (tmp_path / f"{name}.yaml").write_text(table)
    one = AmassSource(tmp_path / "AMASS", splits=tmp_path / "one.yaml")
    same = NpzSource(tmp_path / "plain.npz", splits=tmp_path / "same.yaml")
    MixedSource({"amass": one, "npz": same}, {"amass": 1, "npz": 1}).check()
    assert "splits of two sources" not in caplog.text
    two = NpzSource(tmp_path / "plain.npz", splits=tmp_path / "two.yaml")
    MixedSource({"amass": one, "npz": two}, {"amass": 1, "npz": 1}).check()
    assert (
        "splits of two sources: 2, such as 2 (npz: test, amass: val), 3 (amass: test, npz: val)"
        in caplog.text
    )
    caplog.clear()
    MixedSource({"amass": one, "embedded": source}, {"amass": 1, "embedded": 1}).check()
    assert "1, such as 1 (embedded: test, amass: train)" in caplog.text, "clips 01_01 and 01_03"


def test_what_a_source_of_a_mixture_lacks_is_named_by_its_own_setting():
    mixed = MixedSource({"bvh": BvhSource()}, {"bvh": 1})
    with pytest.raises(
        ValueError, match=r"^data\.source\.sources\.bvh\.path: .* add data\.source\.sources\.bvh\.path"
    ):
        mixed.check()


def test_names_may_say_the_subject(some_poses, tmp_path):
    for name in ("walk1_subject1", "walk1_subject5", "run2_subject1", "01_02"):
        np.savez(tmp_path / f"{name}.npz", poses=some_poses(5))
    assert sorted(set(NpzSource(tmp_path).recordings.subjects)) == ["01", "subject1", "subject5"]


@pytest.mark.parametrize("weights", [{"c": 1}, {"a": 0}, {}, {"a": -1}, {"a": float("inf")}])
def test_weights_that_make_no_sense_are_named(weights):
    with pytest.raises(ValueError, match="weights: expected "):
        MixedSource({"a": NpzSource(), "b": NpzSource()}, weights)
