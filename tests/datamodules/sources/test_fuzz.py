"""Thousands of damaged files: each is read or refused with our own error, and nothing else happens."""

import io
import logging
import re
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from datamodules.sources import SPLITS
from datamodules.sources.amass import AmassSource
from datamodules.sources.bvh import BvhSource
from datamodules.sources.bvh.skeleton import _DIRECTORY, axes_of, read_skeleton
from datamodules.sources.mixed import MixedSource
from datamodules.sources.npz import NpzSource
from datamodules.sources.recordings import _checked
from datamodules.sources.subjects import read_splits

NUMBER = 2000
JUNK = (
    b"nan", b"inf", b"-1e999", b"0", b"9" * 400, b"\x00", b"\xff\xfe", b"{", b"}", b"JOINT", b"\n", b"[", b"&a *a",
    b"!!python/object:os.system x", b"1_0", b"0x10", b"-", b",", "\u0661".encode(),
)  # fmt: skip
OURS = re.compile(
    r"(it cannot be read|it holds no motion|root_orient|poses|betas|gender|clip|subject|frame|joints?|rest_frame|"
    r"HIERARCHY|MOTION|CHANNELS|OFFSET|data\.source\.(skeleton|splits))\b"
)
"""How our own errors begin: with the field, the place in the file, or the setting."""


def damaged(content, rng):
    """Bytes with some of them changed, cut, doubled, moved, or replaced with what breaks readers."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(content) + 1))
        length = int(min(rng.integers(1, 200), len(content) - at))
        kind = rng.integers(6)
        if kind == 0 and len(content):
            content[min(at, len(content) - 1)] = rng.integers(256)
        elif kind == 1:
            del content[at : at + length]
        elif kind == 2:
            content[at:at] = content[at : at + length]
        elif kind == 3:
            content[at : at + (length if rng.random() < 0.5 else 0)] = JUNK[rng.integers(len(JUNK))]
        elif kind == 4 and rng.random() < 0.2:
            del content[at:]
        elif kind == 5:
            other = int(rng.integers(len(content) + 1))
            content[at : at + length], content[other : other + length] = (
                content[other : other + length],
                content[at : at + length],
            )
    return bytes(content)


def damaged_words(text, rng):
    """A text with some of its words replaced, left out or doubled."""
    words = text.split(" ")
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(words)))
        words[at] = (JUNK[rng.integers(len(JUNK))].decode("latin-1"), "", f"{words[at]} {words[at]}")[
            rng.integers(3)
        ]
    return " ".join(words)


def damaged_lines(text, rng):
    """A text with some of its lines doubled, left out, moved, joined, or put where another was."""
    lines = text.split("\n")
    end = len(lines) if rng.random() < 0.3 else lines.index("MOTION") + 3
    for _ in range(rng.integers(1, 4)):
        at, other = (int(rng.integers(min(end, len(lines) - 1))) for _ in range(2))
        kind = rng.integers(5)
        if kind == 0:
            lines.insert(other, lines[at])
        elif kind == 1:
            del lines[at]
        elif kind == 2:
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == 3:
            lines[at : at + 2] = [" ".join(lines[at : at + 2])]
        else:
            words, others = lines[at].split(), lines[other].split()
            lines[at] = " ".join(words[:1] + others[1:])
    return "\n".join(lines)


def packed(members):
    """An archive of files by name, whole and with right checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def odd_array(rng, value):
    """An array of another type, shape or content."""
    kind = rng.integers(9)
    if kind == 0 and value.dtype.kind in "fiu":
        with np.errstate(all="ignore"):
            return value.astype(rng.choice(["f2", "i1", "u8", "c8", "U3", "S5", "?", ">f8"]))
    if kind == 1:
        return value[..., : int(rng.integers(0, 4))] if value.ndim else value.reshape(1)
    if kind == 2:
        return np.asarray(rng.choice([np.nan, np.inf, -1e300, 1e30, 0.0, 5e-324]))
    if kind == 3:
        return np.full(value.shape, rng.choice([np.nan, np.inf, 1e300, 99.0]))
    if kind == 4:
        return value[None] if rng.random() < 0.5 else value.reshape(-1)
    if kind == 5:
        return np.zeros(tuple(rng.integers(0, 5, int(rng.integers(0, 4)))))
    if kind == 6:
        return np.array(rng.choice(["female", "b'male'", "", "\x00", "x" * 1000]))
    if kind == 7:
        spoilt = np.array(value, float) if value.dtype.kind in "fiu" else np.zeros(3)
        spoilt.reshape(-1)[: int(rng.integers(0, 200))] = rng.choice([np.nan, np.inf, 1e308])
        return spoilt
    return np.array({"a": 1}, object)


def damaged_npz(fields, rng):
    """A file with wrong fields, or with damaged bytes, or both."""
    fields = dict(fields)
    for _ in range(rng.integers(0, 3)):
        name = rng.choice(list(fields))
        if rng.random() < 0.2:
            del fields[name]
        else:
            fields[name] = odd_array(rng, np.asarray(fields[name]))
    stream = io.BytesIO()
    np.savez(stream, **fields)
    content = stream.getvalue()
    if (choice := rng.random()) < 0.4:
        return content
    if choice < 0.6:  # most of these fail at a checksum
        return damaged(content, rng)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    head = 128 if rng.random() < 0.7 else len(members[name])  # the header, which says type, order and shape
    members[name] = damaged(members[name][:head], rng) + members[name][head:]
    return packed(members)


def error_of(read, path):
    """What reading a file raises; None where nothing."""
    try:
        with np.errstate(all="ignore"):
            read(path)
    except (ValueError, OSError) as error:
        return error
    return None


def outcomes(make, read, path):
    """How many of `NUMBER` files were read and how many refused; anything else fails."""
    counts = Counter()
    rng = np.random.default_rng(0)
    for number in range(NUMBER):
        path.write_bytes(content := make(rng))
        error = error_of(read, path)
        counts["read" if error is None else "refused"] += 1
        if error is not None:
            is_ours = type(error) is ValueError and OURS.match(str(error)) and len(str(error)) < 2000
            assert is_ours, (number, error, content)
    return counts


def checked(source):
    """Reads a file and checks its motions as the table of all frames does."""

    def read(path):
        motions = list(source.read(path))
        if not motions:
            raise ValueError("it holds no motion")
        return [_checked(motion) for motion in motions]

    return read


@pytest.fixture(autouse=True)
def quiet():
    logging.disable(logging.WARNING)
    yield
    logging.disable(logging.NOTSET)


def report(name, counts):
    print(f"{name}: {NUMBER} damaged files, {counts['read']} read, {counts['refused']} refused, nothing else")
    assert counts["read"] + counts["refused"] == NUMBER
    assert min(counts["read"], counts["refused"]) > NUMBER // 100


@pytest.mark.slow
@pytest.mark.parametrize("source", [AmassSource, NpzSource])
def test_damaged_npz_files_are_read_or_refused(source, some_poses, tmp_path):
    poses = np.zeros((20, 156))
    poses[:, :72] = some_poses(20)
    fields = {"poses": poses, "trans": np.zeros((20, 3)), "betas": np.zeros(16), "gender": np.array("female")}
    fields |= {"mocap_framerate": np.array(120.0)}
    if source is NpzSource:
        fields |= {
            "clip": np.repeat([0, 1], 10),
            "clips": np.array(["01_01", "02_01"]),
            "frame": np.arange(20),
        }
    path = tmp_path / "a.npz"
    report(
        source.name,
        outcomes(lambda rng: damaged_npz(fields, rng), checked(source()), path),
    )


@pytest.mark.slow
def test_damaged_bvh_files_are_read_or_refused(real_poses, make_bvh, tmp_path):
    axes = {"hip": "z x y", "lThigh": "-z -x y", "rThigh": "-z -x y"}
    rest = {name: axes_of(text) for name, text in axes.items()}
    along_x = tmp_path / "x.yaml"
    along_x.write_text(
        (_DIRECTORY / "cmu_daz.yaml").read_text()
        + "rest_axes: {pelvis: z x y, l_hip: -z -x y, r_hip: -z -x y}\n"
    )
    for skeleton, text in (
        ("auto", make_bvh(real_poses[:6])),
        (along_x, make_bvh(real_poses[:6], rest=rest)),
    ):

        def make(rng, text=text):
            if (choice := rng.random()) < 0.3:
                return damaged(text.encode(), rng)
            changed = damaged_words(text, rng) if choice < 0.6 else damaged_lines(text, rng)
            return changed.encode("utf-8", "replace")

        source = BvhSource(skeleton=skeleton)
        report(f"bvh, {Path(skeleton).stem}", outcomes(make, checked(source), tmp_path / "a.bvh"))


@pytest.mark.slow
def test_a_folder_of_damaged_files_gives_records_and_counts(some_poses, make_bvh, real_poses, tmp_path):
    rng = np.random.default_rng(0)
    text = make_bvh(real_poses[:6])
    fields = {"poses": np.zeros((6, 156)), "betas": np.zeros(16), "gender": np.array("female")}
    number = 300
    for place in range(number):
        for folder, name, content in (
            ("amass", f"CMU/{place}/a_poses.npz", damaged_npz(fields, rng)),
            ("bvh", f"{place}/a.bvh", damaged_lines(text, rng).encode()),
        ):
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True)
            path.write_bytes(content)
    parts = {"amass": AmassSource(tmp_path / "amass"), "bvh": BvhSource(tmp_path / "bvh")}
    mixed = MixedSource(parts, {"amass": 1, "bvh": 1})
    mixed.check()
    for name, source in parts.items():
        recordings = source.recordings
        assert len(recordings.skipped) + len(set(recordings.clips)) == number
        assert all(OURS.match(why) for why in recordings.skipped.values())
        print(f"{name}: {number} damaged files in a folder, {len(recordings.skipped)} left out")
    for split in SPLITS:
        records = mixed.records(split, 2000, 0)
        assert all(np.isfinite(getattr(records, name)).all() for name in ("pose", "betas"))


@pytest.mark.slow
def test_damaged_tables_are_read_or_refused(tmp_path):
    table = (_DIRECTORY / "cmu_daz.yaml").read_bytes()
    report("skeleton", outcomes(lambda rng: damaged(table, rng), read_skeleton, tmp_path / "a.yaml"))
    splits = b"train: [a, 'b*']\nval: ['01']\ntest:\n- c\n- d\n"
    subjects = ["a", "b1", "b2", "01", "c", "d"]
    read = lambda path: read_splits(path, subjects)  # noqa: E731
    report("splits", outcomes(lambda rng: damaged(splits, rng), read, tmp_path / "s.yaml"))
