"""Motion files of a folder as one table of frames: read once, kept on disk; bad files are named and counted."""

import hashlib
import json
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from datamodules.cache import cached_samples
from ljn.body import GENDERS
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import NUM_JOINTS
from ljn.reading import brief

_LOG = logging.getLogger(__name__)
_DECIMALS = 5  # of radians: as the embedded source's poses
_MAX_RADIANS = 100.0  # no file turns a body farther, round after round; a damaged number does
_MAX_ANGLE = 4 * np.pi  # no file turns a joint farther
_MAX_BETA = 20.0  # a person 20 standard deviations off spoils a training; fits of people reach 5, bad ones 10
_ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".gz", ".bz2", ".xz", ".tgz")
_FEW_NOTES = 3  # of a kind, each with its file; all of them are counted at the end
_FEW_FILES = 50  # read without a progress bar
_SUBJECT = re.compile(r"(?<![^\W_])subject[-_]?\d+", re.IGNORECASE)
NO_GENDER = -1


class Motion(NamedTuple):
    """A recorded motion, as a reader gives it."""

    poses: np.ndarray  # `(T, 72)` axis-angle, radians; the first three place the body in the body world
    frame: np.ndarray  # `(T,)` int, the frames' numbers in the file
    subject: str | None = None  # None: by the file's place
    name: str = ""  # below that of the file, where this holds several
    gender: str | None = None  # a key of `GENDERS`; None where it is not known
    betas: np.ndarray | None = None  # `(10,)` or `(T, 10)`; None where they are not known
    notes: tuple[str, ...] = ()  # what was wrong and could be passed over


Reader = Callable[[Path], Iterable[Motion]]
"""Reads a file's motions; a `ValueError` says which field is wrong. Nothing else may come of any file's content."""


@dataclass(frozen=True)
class Recordings:
    """All frames of a folder's motions, a row each.

    Attributes:
        pose: `(N, 72)` float32; see `Motion`.
        betas: `(N, 10)` float32, NaN where they are not known.
        gender: `(N,)` int64, codes of `GENDERS`, `NO_GENDER` where it is not known.
        clip: `(N,)` int64, the row of its motion in `clips`.
        frame: `(N,)` int64.
        clips: The motions' names.
        subjects: The motions' subjects, as many.
        upright: How much their bodies stand, as many: 1 upright, 0 lying, the mean of the vertical component of the
            axis that leads from pelvis to head at rest.
        skipped: The files that could not be read, and why.
        notes: What was wrong with others and could be passed over.
        hash: Names the content.
    """

    pose: np.ndarray
    betas: np.ndarray
    gender: np.ndarray
    clip: np.ndarray
    frame: np.ndarray
    clips: tuple[str, ...]
    subjects: tuple[str, ...]
    upright: tuple[float, ...]
    skipped: dict[str, str]
    notes: dict[str, list[str]]
    hash: str


def find_motion_files(path: Path, suffix: str) -> list[Path]:
    """The files of a folder and all below with a suffix, or the one file, in the order of their names.

    Raises:
        FileNotFoundError: There is no such file or folder, or none of these in it.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise FileNotFoundError(f"data.source.path: no file or folder '{path}'")
    found: list[Path] = []
    num_archives, seen = 0, set()
    for folder, below, names in os.walk(path, followlinks=True):  # a data set may be a link to another disk
        if (place := os.path.realpath(folder)) in seen:
            below.clear()
            continue
        seen.add(place)
        # macOS leaves a ._NAME beside each file.
        files = [name for name in names if not name.startswith("._")]
        found += [Path(folder, name) for name in files if name.lower().endswith(suffix)]
        num_archives += sum(name.lower().endswith(_ARCHIVES) for name in files)
    found = sorted(file for file in found if file.is_file())
    if not found:
        hint = f"; unpack the {num_archives} archives there" if num_archives else ""
        raise FileNotFoundError(f"data.source.path: no {suffix} file in '{path}' or below{hint}")
    return found


def subject_of(file: Path, root: Path) -> str:
    """A file's subject by its place: its folder below the root; right in it, its name up to a `_`, `-` or blank.

    But `walk1_subject5` is of `subject5`, wherever it is.
    """
    if (match := _SUBJECT.search(file.stem)) is not None:
        return match[0]
    folder = file.parent.relative_to(root.parent if root.is_file() else root).as_posix()
    if folder != ".":
        return folder
    return file.stem.replace("-", "_").replace(" ", "_").split("_")[0] or file.stem


def read_recordings(
    root: Path,
    files: Sequence[Path],
    read: Reader,
    settings: str,
    cache_dir: Path | None,
    subject: Callable[[Path, Path], str] = subject_of,
) -> Recordings:
    """The table of some files below a root, from `cache_dir` where it is there already.

    Each bad file is logged and left out, and their number after the last.

    Args:
        root: The folder, or the one file.
        files: What to read.
        read: Reads one; only its `ValueError` and `OSError` are expected.
        settings: All that `read` depends on but the file.
        cache_dir: Where the table is kept; None for nowhere.
        subject: Says whose motion a file below the root is, where `read` does not.

    Raises:
        ValueError: No file has a motion.
    """

    def make() -> dict[str, torch.Tensor]:
        return _tensors(_gather(root, files, read, subject))

    if cache_dir is None:
        stored = make()
    else:
        digest = hashlib.sha256(f"{settings} {root.resolve()}".encode())
        for file in files:
            status = file.stat()
            digest.update(f"{file.relative_to(root)} {status.st_size} {status.st_mtime_ns}\n".encode())
        stored = cached_samples(cache_dir, f"motion-{digest.hexdigest()[:16]}", make)
    about = json.loads(stored["about"].numpy().tobytes())
    pose, betas, gender, clip, frame = (
        stored[name].numpy() for name in ("pose", "betas", "gender", "clip", "frame")
    )
    clips, subjects, upright = (tuple(about[name]) for name in ("clips", "subjects", "upright"))
    others = about["skipped"], about["notes"], about["hash"]
    recordings = Recordings(pose, betas, gender, clip, frame, clips, subjects, upright, *others)
    skipped, notes = recordings.skipped, recordings.notes
    _LOG.info(
        "%d of %d files read, %d motions of %d subjects, %d frames",
        *(len(files) - len(skipped), len(files), len(clips)),
        *(len(set(subjects)), len(pose)),
    )
    kinds = Counter(kind for said in notes.values() for kind in {_kind(note) for note in said})
    for kind, count in kinds.most_common():
        _LOG.warning("%d of %d files: %s", count, len(files), kind)
    if skipped:
        name, why = next(iter(skipped.items()))
        _LOG.warning("%d of %d files left out; the first is %s: %s", len(skipped), len(files), name, why)
    return recordings


def _kind(note: str) -> str:
    """A note without the numbers in it."""
    return re.sub(r"'[^']*'|\d+", "...", note)


def _gather(
    root: Path, files: Sequence[Path], read: Reader, subject: Callable[[Path, Path], str]
) -> dict[str, Any]:
    """Columns and names of all files' motions."""
    parts: list[tuple[np.ndarray, ...]] = []
    clips: list[str] = []
    subjects: list[str] = []
    upright: list[float] = []
    skipped: dict[str, str] = {}
    notes: dict[str, list[str]] = {}
    kinds: Counter[str] = Counter()
    folder = root.parent if root.is_file() else root
    for file in tqdm(files, unit="file", desc="motions", disable=None if len(files) > _FEW_FILES else True):
        place = file.relative_to(folder).as_posix()
        try:
            motions = [_checked(motion) for motion in read(file)]
            if not motions:
                raise ValueError("it holds no motion")
        except (ValueError, OSError) as error:
            skipped[place] = brief(str(error), 500)
            _LOG.warning("%s left out: %s", place, skipped[place])
            continue
        for motion, columns in motions:
            stem = place.removesuffix(file.suffix) if len(files) > 1 or not motion.name else ""
            clips.append("/".join(filter(None, (stem, motion.name))).replace("|", "_"))
            subjects.append(motion.subject or subject(file, root))
            upright.append(_upright(columns[0][:, :3]))
            parts.append((*columns, np.full(len(columns[0]), len(clips) - 1)))
            for note in motion.notes:
                notes.setdefault(place, []).append(note)
                kinds[kind := _kind(note)] += 1
                if kinds[kind] <= _FEW_NOTES:
                    _LOG.warning("%s: %s", place, note)
    if not clips:
        name, why = next(iter(skipped.items()))
        raise ValueError(
            f"data.source.path: none of {len(files)} files can be read; the first is {name}: {why}"
        )
    pose, betas, gender, frame, clip = (np.concatenate(column) for column in zip(*parts))
    return {
        **{"pose": pose, "betas": betas, "gender": gender, "clip": clip, "frame": frame},
        "about": {
            "clips": clips,
            "subjects": subjects,
            "upright": upright,
            "skipped": skipped,
            "notes": notes,
        },
    }


def _upright(rotvec: np.ndarray) -> float:
    """See `Recordings.upright`; of the pelvis' rotations `(T, 3)` into the body world, which is z up."""
    x, y, z = rotvec.T.astype(np.float64)
    angle = np.sqrt(x**2 + y**2 + z**2)
    # Row z, column y of Rodrigues' formula.
    return round(
        float((y * z * 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 + x * np.sinc(angle / np.pi)).mean()), 3
    )


def _checked(motion: Motion) -> tuple[Motion, tuple[np.ndarray, ...]]:
    """A motion's columns pose, betas, gender and frame, without frames that hold no pose."""
    poses = np.asarray(motion.poses)
    if poses.ndim != 2 or poses.shape[1] != 3 * NUM_JOINTS:
        raise ValueError(f"poses: expected shape (T, {3 * NUM_JOINTS}), got {poses.shape}")
    number = len(poses)
    if number == 0:
        raise ValueError("poses: no frame")
    poses = poses.astype(np.float64)
    with np.errstate(all="ignore"):
        angles = np.linalg.norm(poses[:, 3:].reshape(number, NUM_JOINTS - 1, 3), axis=2)
    is_right = (np.abs(poses) <= _MAX_RADIANS).all(1) & (angles <= _MAX_ANGLE).all(1)  # false for NaN
    if np.isfinite(poses).all() and is_right.mean() < 0.5:
        raise ValueError(
            f"poses: rotations that no joint has in {(~is_right).sum()} of {number} frames; expected radians, "
            "not degrees"
        )
    betas = np.full((number, NUM_BETAS), np.nan)
    if motion.betas is not None:
        given = np.broadcast_to(np.asarray(motion.betas, np.float64), betas.shape)
        if not (np.abs(given[is_right]) <= _MAX_BETA).all():
            raise ValueError(f"betas: NaN, or beyond {_MAX_BETA:g} standard deviations, which no one is")
        betas[:] = given
    if not is_right.any():
        raise ValueError(f"poses: NaN, or rotations that no joint has, in all {number} frames")
    if not is_right.all():
        note = (
            f"poses: NaN, or rotations that no joint has, in {(~is_right).sum()} of {number} frames, left out"
        )
        motion = motion._replace(notes=(*motion.notes, note))
    gender = np.full(number, GENDERS.get(motion.gender or "", NO_GENDER))
    columns = (poses.round(_DECIMALS).astype(np.float32), betas.astype(np.float32), gender, motion.frame)
    return motion, tuple(column[is_right] for column in columns)


def _tensors(gathered: dict[str, Any]) -> dict[str, torch.Tensor]:
    """What is stored: the columns, and all else as the letters of a JSON text."""
    about = gathered.pop("about")
    digest = hashlib.sha256()
    for name, column in gathered.items():
        gathered[name] = column = np.ascontiguousarray(
            column if column.dtype.kind == "f" else column.astype(np.int64)
        )
        digest.update(f"{name} {column.shape}".encode() + column.tobytes())
    about["hash"] = hashlib.sha256(
        digest.digest() + json.dumps([about["clips"], about["subjects"]]).encode()
    ).hexdigest()[:16]
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    return {
        **{name: torch.from_numpy(column) for name, column in gathered.items()},
        "about": torch.tensor(text),
    }


def steps(
    number: int, rate_hz: float | None, wanted_hz: float | None, stride: int, first: int = 0
) -> np.ndarray:
    """The numbers of the frames that are taken of a file with `number` frames at a rate.

    Args:
        number: Frames of the file.
        rate_hz: Their rate; None where the file does not say it, and then all of them count.
        wanted_hz: The rate to come down to, up to rounding; None for the file's own.
        stride: Of those, every how many-th is taken.
        first: Frames at the beginning that are left out.
    """
    step = stride
    if wanted_hz is not None and rate_hz is not None:
        step *= max(1, round(rate_hz / wanted_hz))
    return np.arange(first, number, step)


def by_clip(names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Each name with the rows that have it, in the order of their first row."""
    unique, first, inverse = np.unique(np.asarray(names), return_index=True, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(inverse))[:-1])
    for index in np.argsort(first):
        yield str(unique[index]), rows[index]
