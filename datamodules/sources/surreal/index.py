"""What clips a SURREAL tree has, read once: a line for each file, appended as it is read, in a small file of the cache.

Cut off, the next call goes on from the last whole line; a file that has changed since, or could not be read, is read
again.
"""

import hashlib
import json
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from datamodules.sources import SPLITS
from datamodules.sources.surreal.files import INFO, Clip, read_clip
from ljn.reading import reason

_LOG = logging.getLogger(__name__)
_VERSION = 1  # of a line's form, and of what is checked of a clip
_NUM_NAMED = 10  # damaged files that are named one by one
_PLACES = ("", "cmu", "data/cmu", "SURREAL/data/cmu")


class ClipEntry(NamedTuple):
    """What is known of a clip without reading it again.

    Attributes:
        name: Path of its files below the tree, without `_info.mat`: `train/run0/01_01/01_01_c0001`.
        num_frames: T.
        bad_frames: Frames without a usable pose or shape.
        content: 16 hex digits that name its poses, shapes and genders.
        problem: Why it cannot be read; then all else is empty.
    """

    name: str
    num_frames: int = 0
    bad_frames: tuple[int, ...] = ()
    content: str = ""
    problem: str = ""

    @property
    def split(self) -> str:
        """The folder of the tree that it lies in."""
        return self.name.partition("/")[0]

    @property
    def sequence(self) -> str:
        """The motion sequence of CMU's: `1_1` of `01_01` and `ung_01_01`."""
        return normalised(self.name.split("/")[-2])

    @property
    def subject(self) -> str:
        """Who moves: `1` of `01_01`; of a folder that is named otherwise, its name."""
        first, _, second = self.sequence.partition("_")
        return first if second else self.sequence

    @property
    def good_frames(self) -> np.ndarray:
        """Numbers of the frames that can be used, ascending."""
        return np.setdiff1d(np.arange(self.num_frames), self.bad_frames)


def normalised(sequence: str) -> str:
    """A sequence's or subject's name as entries have it: `18`, `143_21`, of `ung_143_21` and `018`."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", sequence.removeprefix("ung_"))


def find_tree(path: Path | None, run: str) -> Path:
    """The folder with `train`, `val` or `test`, in each the run's clips: the given one, or its `cmu` or `data/cmu`.

    Raises:
        FileNotFoundError: There is none, or none of its parts has such a run.
    """
    expected = f"cmu/{{train,val,test}}/{run}/SEQUENCE/SEQUENCE_c0001{INFO}"
    if path is None or not path.is_dir():
        raise FileNotFoundError(
            f"data.source.path: expected the folder of SURREAL with {expected}, got {path or 'null'}; SURREAL is to be "
            "had from https://www.di.ens.fr/willow/research/surreal/data, for research, after registration"
        )
    for place in _PLACES:
        tree = path / place
        if any((tree / split / run).is_dir() for split in SPLITS):
            return tree
    for place in _PLACES:
        if parts := [split for split in SPLITS if (path / place / split).is_dir()]:
            folders = [
                folder for part in parts for folder in (path / place / part).iterdir() if folder.is_dir()
            ]
            runs = sorted({folder.name for folder in folders})[:5]
            raise FileNotFoundError(
                f"data.source.run: expected {run} in {path / place}/{{{','.join(parts)}}}, which have "
                f"{', '.join(runs) or 'nothing'}; choose one of them with data.source.run"
            )
    raise FileNotFoundError(f"data.source.path: no {expected} in {path}; give the folder that has cmu in it")


def read_index(tree: Path, run: str, cache_dir: Path | None) -> list[ClipEntry]:
    """The clips of a tree, split by split and by name, those that cannot be read too; read anew without a cache.

    Raises:
        ValueError: There is no clip, or none that can be read.
    """
    path = None
    if cache_dir is not None:
        place = hashlib.sha256(f"{_VERSION} {tree.resolve()} {run}".encode()).hexdigest()[:16]
        path = cache_dir / f"surreal-{place}.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
    known = dict(_lines(path))
    # Whether a file can be read hangs on more than its size and time: on permissions, a link's target, a lent disk.
    usable = {file for file, entry in known.items() if not entry.problem}
    files = [
        (f"{split}/{run}/{name}", size, time)
        for split in SPLITS
        for name, size, time in _walk(tree / split / run)
    ]
    if not files:
        raise ValueError(f"data.source.path: no file *{INFO} in {tree}/*/{run}; is the download complete?")
    if missing := [file for file in files if file not in usable]:
        with open(path or os.devnull, "ab", buffering=0) as log:
            log.write(b"\n")  # ends a line that was cut off
            for file in tqdm(missing, desc=f"index of {tree.name}", unit="clip", disable=None, leave=False):
                if (entry := _entry(tree, file[0])) != known.get(file):
                    known[file] = entry
                    log.write(f"{json.dumps([*file, *entry[1:]])}\n".encode())
    entries = [known[file] for file in files]
    _report(entries, "the index" if path is None else str(path))
    return entries


def _report(entries: list[ClipEntry], place: str) -> None:
    damaged = [entry for entry in entries if entry.problem]
    for entry in damaged[:_NUM_NAMED]:
        _LOG.warning("left out: %s", entry.problem)
    bad = [entry for entry in entries if entry.bad_frames]
    for entry in bad[:_NUM_NAMED]:
        _LOG.warning(
            "left out: of %s%s %d of %d frames, whose pose or shape is NaN, infinite or beyond all bodies",
            entry.name, INFO, len(entry.bad_frames), entry.num_frames,
        )  # fmt: skip
    if damaged or bad:
        number = sum(len(entry.bad_frames) for entry in bad)
        _LOG.warning(
            "SURREAL: %d of %d files, and %d frames of others, are left out; all are named in %s",
            len(damaged), len(entries), number, place,
        )  # fmt: skip
    if len(damaged) == len(entries):
        raise ValueError(
            f"data.source.path: none of {len(entries)} files can be read; the first: {damaged[0].problem}"
        )


def _walk(folder: Path) -> Iterator[tuple[str, int, int]]:
    """Of each clip below a run's folder its path there, without the ending, and its file's size and time; ordered.

    Hidden files are none of SURREAL's: `._01_01_c0001_info.mat` of a Mac is of that form. For a folder that cannot be
    listed stands a clip by the name of `*`, which cannot be read either.
    """
    if not folder.is_dir():
        return
    for sequence in sorted(os.listdir(folder)):
        if sequence.startswith(".") or not os.path.isdir(folder / sequence):
            continue
        try:
            names = sorted(os.listdir(folder / sequence))
        except OSError:
            names = [f"*{INFO}"]
        for name in names:
            if name.endswith(INFO) and not name.startswith("."):
                yield f"{sequence}/{name.removesuffix(INFO)}", *_stamp(folder / sequence / name)


def _stamp(path: Path) -> tuple[int, int]:
    try:
        stamp = path.stat()
    except OSError:  # which reading it will say
        return 0, 0
    return stamp.st_size, stamp.st_mtime_ns


def _entry(tree: Path, name: str) -> ClipEntry:
    path = tree / f"{name}{INFO}"
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise ValueError(f"{path}: expected a file, got a folder, or a pipe, or a device")
        clip = read_clip(path)
    except (ValueError, OSError) as error:
        return ClipEntry(name, problem=reason(error, 400))
    return ClipEntry(name, len(clip), tuple(np.flatnonzero(~clip.is_good).tolist()), _content(clip))


def _content(clip: Clip) -> str:
    digest = hashlib.sha256()
    for values in (clip.pose, clip.betas, clip.gender):
        digest.update(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes())
    return digest.hexdigest()[:16]


def _lines(path: Path | None) -> Iterator[tuple[tuple[str, int, int], ClipEntry]]:
    """The lines of an index, each file's last one last; those that are cut off or of another form are passed over."""
    if path is None or not path.is_file():
        return
    for line in path.read_bytes().split(b"\n"):
        try:
            name, size, time, number, bad, content, problem = json.loads(line)
            is_text = all(isinstance(value, str) for value in (name, content, problem))
            if is_text and all(isinstance(value, int) for value in (size, time, number, *bad)):
                yield (name, size, time), ClipEntry(name, number, tuple(bad), content, problem)
        except (ValueError, TypeError, RecursionError):
            continue
