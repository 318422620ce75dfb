import inspect
import logging
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from datamodules.sources import SPLITS
from datamodules.sources.surreal import SurrealDepthSource, SurrealSource
from datamodules.sources.surreal import index as index_module
from datamodules.sources.surreal.index import ClipEntry
from datamodules.sources.surreal.source import even_shares
from tests.datamodules.surreal.conftest import write_plain
from tests.datamodules.surreal.writer import clip_path

CONF = Path(__file__).parents[3] / "conf/data/source"
LENGTHS = (6, 9, 5, 1, 30)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Six subjects of training and three of test, with clips of all lengths, some skipped or damaged."""
    root = tmp_path_factory.mktemp("surreal")
    for subject in range(1, 7):
        for number, length in enumerate(LENGTHS, 1):
            write_plain(root, "train", f"{subject:02d}_01", number, length)
    for subject in (20, 21, 22):
        for number, length in enumerate(LENGTHS, 1):
            write_plain(root, "test", f"{subject}_01", number, length)
    write_plain(root, "val", "21_01", 1, 6)
    write_plain(root, "train", "ung_22_03")  # of a subject of the test set
    for sequence in ("18_05", "019_02", "143_21", "143_22"):
        write_plain(root, "train", sequence)
    fields = write_plain(root, "train", "30_01")
    write_plain(root, "train", "30_01", pose=np.where(np.arange(8) < 3, np.nan, fields["pose"]))
    Path(f"{clip_path(root, 'train', '31_01')}_info.mat").parent.mkdir(parents=True)
    Path(f"{clip_path(root, 'train', '31_01')}_info.mat").write_bytes(b"no file of MATLAB's")
    return root


def test_the_protocol(tree):
    source = SurrealSource(tree)
    motion = {split: source.motion(split) for split in SPLITS}
    assert motion["train"] == {
        "clips": 20,
        "frames": 6 * 45 + 8 + 5,
        "subjects": 8,
        "sequences": 8,
        "damaged": 1,
    }
    assert motion["test"] == {"clips": 9, "frames": 135, "subjects": 3, "sequences": 3, "damaged": 0}
    assert motion["val"]["clips"] == 1
    records = {split: source.records(split, number, 0) for split, number in zip(SPLITS, (100, 6, 40))}
    subjects = {
        split: {name.split("/")[2].split("_")[-2] for name in of.sequence} for split, of in records.items()
    }
    assert not subjects["train"] & (subjects["test"] | subjects["val"])
    assert not subjects["train"] & {"18", "019", "22"}
    assert subjects["val"] <= subjects["test"]
    for split, of in records.items():
        assert of.has_heading
        assert len(set(zip(of.sequence, of.frame))) == len(of), "no frame twice"
        assert min(np.unique(of.sequence, return_counts=True)[1]) >= 3
        assert all(name.startswith(f"{split}/run0/") for name in of.sequence)
        assert not any(name.endswith(("_c0003", "_c0004")) for name in of.sequence), "five frames, or one"
    of_damaged = records["train"].sequence == "train/run0/30_01/30_01_c0001"
    assert (records["train"].frame[of_damaged] >= 3).all()


def test_records_are_the_files_own_poses_shapes_and_genders(tree):
    records = SurrealSource(tree).records("test", 12, 4)
    for row, name in enumerate(records.sequence):
        _, _, sequence, clip = name.split("/")
        number = int(clip[-4:])
        fields = write_plain(tree, "test", sequence, number, LENGTHS[number - 1])
        frame = records.frame[row]
        np.testing.assert_array_equal(records.pose[row], fields["pose"][:, frame])
        np.testing.assert_array_equal(records.betas[row], fields["shape"][:, frame].astype(np.float32))
        assert records.gender[row] == fields["gender"][frame]


def test_fewer_samples_take_three_of_fewer_clips_and_more_take_frames_again(tree, caplog):
    source = SurrealSource(tree)
    few = source.records("train", 13, 0)
    assert sorted(np.unique(few.sequence, return_counts=True)[1]) == [3, 3, 3, 4]
    assert len(np.unique(source.records("train", 2, 0).sequence)) == 1
    many = source.records("val", 20, 0)
    assert sorted(np.unique(many.frame, return_counts=True)[1]) == [3, 3, 3, 3, 4, 4]
    assert "val has 6 frames for 20 samples" in caplog.text


def test_even_shares():
    rng = np.random.default_rng(0)
    for _ in range(200):
        rooms, total = rng.integers(1, 9, rng.integers(1, 7)), int(rng.integers(1, 60))
        shares = even_shares(rooms, total, rng)
        rooms = rooms * max(1, -(-total // rooms.sum()))
        assert shares.sum() == total
        assert (shares <= rooms).all()
        is_open = shares < rooms
        assert not is_open.any() or shares[is_open].min() >= shares.max() - 1


def test_the_same_seed_gives_the_same_records_wherever_the_tree_lies(tree, tmp_path):
    hashes = [SurrealSource(tree).records("train", 50, seed).hash for seed in (0, 0, 1)]
    assert hashes[0] == hashes[1] != hashes[2]
    (tmp_path / "moved").symlink_to(tree / "cmu")
    moved = SurrealSource(tmp_path / "moved")
    assert moved.records("train", 50, 0).hash == hashes[0]
    assert moved.fingerprint == SurrealSource(tree).fingerprint
    assert pickle.loads(pickle.dumps(moved)).records("train", 50, 0).hash == hashes[0]


def test_the_fingerprint_follows_settings_and_content(tmp_path):
    for subject in (1, 2, 18):
        for number, length in enumerate((6, 9), 1):
            write_plain(tmp_path, "train", f"{subject}_1", number, length)
            write_plain(tmp_path, "train", f"{subject}_1", number, length, run="run1")
    settings = {"run": "run1", "min_frames": 7, "samples_per_clip": 2, "skip": (), "genders": ("neutral",)}
    assert inspect.signature(SurrealSource).parameters.keys() == {"path", *settings}
    prints = [SurrealSource(tmp_path).fingerprint]
    prints += [SurrealSource(tmp_path, **{name: value}).fingerprint for name, value in settings.items()]
    write_plain(tmp_path, "train", "2_1", 1, 6, gender=np.full(6, 0), shape=np.zeros((10, 6)))
    prints.append(SurrealSource(tmp_path).fingerprint)
    assert len(set(prints)) == len(prints)


def test_an_index_that_was_cut_off_is_gone_on_with_and_a_changed_file_is_read_again(tmp_path, monkeypatch):
    for number in range(1, 7):
        write_plain(tmp_path, "train", "01_01", number)
    read = []
    original = index_module.read_clip

    def counted(path):
        if len(read) == 3 and not any(tmp_path.glob("cache/whole")):
            raise KeyboardInterrupt
        read.append(path.name)
        return original(path)

    monkeypatch.setattr(index_module, "read_clip", counted)

    def source():
        made = SurrealSource(tmp_path)
        made.cache_dir = tmp_path / "cache"
        return made

    with pytest.raises(KeyboardInterrupt):
        source().check()
    (tmp_path / "cache" / "whole").touch()
    [path] = (tmp_path / "cache").glob("surreal-*.jsonl")
    path.write_bytes(path.read_bytes()[:-9])  # the last line was being written
    expected = SurrealSource(tmp_path).entries
    read.clear()
    assert source().entries == expected
    assert len(read) == 4
    read.clear()
    assert source().entries == expected
    assert read == []
    file = Path(f"{clip_path(tmp_path, 'train', '01_01', 2)}_info.mat")
    os.utime(file, ns=(1, 1))
    path.write_bytes(path.read_bytes() + b'[1, 2]\nnull\n[["a"], 1, 1, 1, [], "", ""]\n{"a": 1}\n\xff\n')
    assert source().entries == expected
    assert read == [file.name]


def test_strays_are_passed_over_or_named_and_what_becomes_readable_is_read(tmp_path, caplog):
    for number in (1, 2):
        write_plain(tmp_path, "train", "01_01", number)
    folder = clip_path(tmp_path, "train", "01_01").parent
    target = tmp_path / "elsewhere.mat"
    (folder / "01_01_c0003_info.mat").symlink_to(target)
    (folder / "01_01_c0004_info.mat").mkdir()
    os.mkfifo(folder / "01_01_c0005_info.mat")
    for name in ("._01_01_c0001_info.mat", ".DS_Store", "01_01_c0001_info copy.mat", "../.DS_Store"):
        (folder / name).write_bytes(b"of another program")
    (folder.parent / "self").symlink_to("self")

    def problems():
        source = SurrealSource(tmp_path)
        source.cache_dir = tmp_path / "cache"
        return {entry.name[-5:]: entry.problem for entry in source.entries}

    found = problems()
    assert [name for name, problem in found.items() if not problem] == ["c0001", "c0002"]
    assert "01_01_c0003_info.mat" in found["c0003"]
    assert all("expected a file, got a folder, or a pipe" in found[name] for name in ("c0004", "c0005"))
    assert "3 of 5 files, and 0 frames of others, are left out" in caplog.text
    [index] = (tmp_path / "cache").iterdir()
    size = index.stat().st_size
    assert problems() == found
    assert index.stat().st_size < size + 10, "what is still wrong is not written again"
    target.write_bytes((folder / "01_01_c0001_info.mat").read_bytes())
    assert not problems()["c0003"]


def test_a_folder_that_cannot_be_listed_is_named_and_the_rest_goes_on(tmp_path, monkeypatch):
    for sequence in ("01_01", "02_01"):
        write_plain(tmp_path, "train", sequence)
    listed = os.listdir

    def refused(path):
        if Path(path).name == "02_01":
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    monkeypatch.setattr(os, "listdir", refused)
    first, second = SurrealSource(tmp_path).entries
    assert not first.problem
    assert "train/run0/02_01/*_info.mat" in second.problem


def test_a_clip_that_is_exchanged_after_the_index_is_named(tmp_path):
    write_plain(tmp_path, "train", "01_01", num_frames=9)
    source = SurrealSource(tmp_path)
    source.check()
    write_plain(tmp_path, "train", "01_01", num_frames=6)
    with pytest.raises(ValueError, match=r"01_01_c0001_info\.mat: 6 frames, expected 9 .*has it changed"):
        source.records("train", 9, 0)


def test_names_are_those_of_sequences_and_subjects():
    for folder, sequence, subject in (
        ("01_01", "1_1", "1"), ("ung_104_02", "104_2", "104"), ("143_21", "143_21", "143"), ("h36m", "h36m", "h36m"),
    ):  # fmt: skip
        entry = ClipEntry(f"train/run0/{folder}/{folder}_c0001", 3, (1,))
        assert (entry.sequence, entry.subject, entry.split) == (sequence, subject, "train")
        assert entry.good_frames.tolist() == [0, 2]


def test_what_is_damaged_is_named_and_counted(tree, caplog):
    with caplog.at_level(logging.WARNING):
        SurrealSource(tree).check()
    assert "31_01_c0001_info.mat: cannot be read as a MATLAB file" in caplog.text
    assert "of train/run0/30_01/30_01_c0001_info.mat 3 of 8 frames" in caplog.text
    assert "1 of 53 files, and 3 frames of others, are left out" in caplog.text
    assert "subjects 22 are in training and test" in caplog.text


def test_a_missing_tree_is_named_with_what_was_expected(tmp_path, tree, caplog):
    for path in (None, tmp_path / "none"):
        with pytest.raises(
            FileNotFoundError, match=r"path: expected the folder of SURREAL with cmu/.*registration"
        ):
            SurrealSource(path).check()
    with pytest.raises(FileNotFoundError, match=r"no cmu/\{train,val,test\}/run0/SEQUENCE"):
        SurrealSource(tmp_path).check()
    (tree / "cmu" / "train" / ".DS_Store").touch()
    with pytest.raises(FileNotFoundError, match=r"run: expected run3 .*which have run0;"):
        SurrealSource(tree, run="run3").check()
    (tmp_path / "cmu" / "test" / "run0").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"no file .*is the download complete"):
        SurrealSource(tmp_path).check()
    write_plain(tmp_path, "test", "01_01", num_frames=5)
    with pytest.raises(ValueError, match=r"of 1 clips in .* none has 6 frames or more"):
        SurrealSource(tmp_path).check()
    write_plain(tmp_path, "test", "01_01", 2)
    with caplog.at_level(logging.WARNING):
        SurrealSource(tmp_path).check()
    assert "no clip for 'train': there is no" in caplog.text
    with pytest.raises(ValueError, match=r"'train': there is no .*cmu/train/run0; download this part"):
        SurrealSource(tmp_path).records("train", 3, 0)
    write_plain(tmp_path, "train", "18_01")
    with pytest.raises(ValueError, match=r"no usable clip for 'train' in .* skipped"):
        SurrealSource(tmp_path).records("train", 3, 0)
    assert len(SurrealSource(tmp_path).records("val", 3, 0)) == 3, "of test, where there is no val"
    for split, sequence, number in (("train", "18_01", 1), ("test", "01_01", 1), ("test", "01_01", 2)):
        write_plain(tmp_path, split, sequence, number, gender=4)
    with pytest.raises(ValueError, match=r"none of 3 files can be read; the first: .*gender: expected 0"):
        SurrealSource(tmp_path).check()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples_per_clip": 7}, "samples_per_clip: expected 1 to min_frames, 6"),
        ({"genders": ("female", "neutral")}, r"genders \(body\.genders\): expected female and male, or one"),
        ({"genders": ("other",)}, r"genders \(body\.genders\)"),
    ],
)
def test_settings_that_make_no_sense_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        SurrealSource("anywhere", **settings)
    with pytest.raises(ValueError, match="radial: expected true, false or auto, got 'both'"):
        SurrealDepthSource(radial="both")


def test_one_body_serves_all_genders(tree):
    assert set(SurrealSource(tree, genders=["neutral"]).records("test", 9, 0).gender) == {2}


def test_the_config_files_hold_the_defaults():
    for name, source in (("surreal", SurrealSource), ("surreal_depth", SurrealDepthSource)):
        config = OmegaConf.to_container(OmegaConf.load(CONF / f"{name}.yaml"), resolve=False)
        parameters = inspect.signature(SurrealSource).parameters | inspect.signature(source).parameters
        for key in config.keys() - {"defaults", "_target_", "_convert_", "genders", "body_path"}:
            value = tuple(config[key]) if isinstance(config[key], list) else config[key]
            assert value == parameters[key].default, key
