"""Recorded poses as records: what the sources of motion files share."""

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.filters import PoseFilters
from datamodules.sources.recordings import (
    Motion,
    Recordings,
    find_motion_files,
    read_recordings,
    steps,
    subject_of,
)
from datamodules.sources.shapes import Shapes, check_shapes, draw_shapes
from datamodules.sources.subjects import Subjects, check_shares, read_splits, split_by_hash
from ljn.body import GENDERS

_LOG = logging.getLogger(__name__)
_BLOCK = 4096  # records at once; their random numbers hang on it
_READING = 3  # of the tables that are kept: changed where a file is read otherwise
_ORDER, _SHAPES = range(2)
SHAPES = ("recorded", "drawn")
_UPRIGHT = 0.5  # of `Recordings.upright`: bodies of less lie, or stand on their heads
_MANY_LYING = 0.2  # share of the motions; of 93 of CMU none


class RecordedSource(ABC):
    """Poses of motion files that a user brings.

    Each frame of a split is taken once, in random order, before any is taken twice. A record has its file's shape and
    gender where this says them, and drawn ones otherwise, or if its gender is none of `genders`.

    Args:
        path: A folder of files, or one file.
        splits: YAML file of the subjects of each split; None splits by a hash of their names. See `read_splits`.
        split_shares: Shares of the subjects that train, validation and test get without such a file.
        rate_hz: Frames a second, of files that have more and say so; None takes all.
        stride: Of these, every how many-th is taken.
        shapes: `recorded` or `drawn`: whether shapes are the files', where they have any.
        max_beta: Drawn shape coefficients are standard normal, drawn again where they exceed this.
        genders: The genders that records have, keys of `ljn.body.GENDERS`; drawn ones come equally often.
        max_heading_deg, pelvis_height_m, max_penetration_m: See `PoseFilters`.

    Attributes:
        cache_dir: Where the table of all frames is kept; None for nowhere.
    """

    name: str
    version = 1
    licence: str
    suffix: str
    other_axes = "Poses have to lead into a world that is z up"
    """What to do about files with another vertical axis."""
    cache_dir: Path | None = None

    def __init__(
        self,
        path: str | Path | None = None,
        splits: str | Path | None = None,
        split_shares: Sequence[float] = (0.8, 0.1, 0.1),
        rate_hz: float | None = None,
        stride: int = 1,
        shapes: str = "recorded",
        max_beta: float = 3.0,
        genders: Sequence[str] = ("female", "male"),
        max_heading_deg: float | None = None,
        pelvis_height_m: Sequence[float] | None = None,
        max_penetration_m: float | None = None,
    ) -> None:
        check_shapes(genders, max_beta)
        check_shares(split_shares)
        if shapes not in SHAPES:
            raise ValueError(f"shapes: expected one of {', '.join(SHAPES)}, got {shapes!r}")
        if rate_hz is not None and not 0 < rate_hz < np.inf:
            raise ValueError(f"rate_hz: expected frames a second, more than 0, or null, got {rate_hz}")
        if type(stride) is not int or stride < 1:
            raise ValueError(f"stride: expected a whole number of 1 or more, got {stride!r}")
        self.path = None if path is None else Path(path)
        self.splits = None if splits is None else Path(splits)
        self.split_shares = tuple(split_shares)
        self.rate_hz = rate_hz
        self.stride = stride
        self.shapes = shapes
        self.max_beta = max_beta
        self.genders = tuple(genders)
        self.filters = PoseFilters(max_heading_deg, pelvis_height_m, max_penetration_m)

    @abstractmethod
    def read(self, path: Path) -> Iterable[Motion]:
        """A file's motions; see `datamodules.sources.recordings.Reader`."""

    def is_motion(self, path: Path) -> bool:
        """Whether a file with the suffix is to be read at all, by its name."""
        return True

    def subject_of(self, file: Path, root: Path) -> str:
        """Whose motion a file below the root is, where `read` does not say it; see `recordings.subject_of`."""
        return subject_of(file, root)

    @property
    def reader_settings(self) -> str:
        """All that `read` depends on beside the file, as text."""
        return f"{self.name} {self.version} {_READING} {self.rate_hz} {self.stride}"

    def steps(self, number: int, rate_hz: float | None, first: int = 0) -> np.ndarray:
        """The numbers of the frames that are taken of a file; see `steps`."""
        return steps(number, rate_hz, self.rate_hz, self.stride, first)

    def check(self) -> None:
        """Read the files; see `PoseSource.check`."""
        _ = self._subjects

    @cached_property
    def recordings(self) -> Recordings:
        """All frames that are there."""
        if self.path is None:
            raise ValueError(
                f"data.source.path: expected a folder of {self.suffix} files, or one, got null; add "
                "data.source.path=FOLDER"
            )
        files = [file for file in find_motion_files(self.path, self.suffix) if self.is_motion(file)]
        if not files:
            raise FileNotFoundError(f"data.source.path: no {self.suffix} file of a motion in '{self.path}'")
        recordings = read_recordings(
            self.path, files, self.read, self.reader_settings, self.cache_dir, self.subject_of
        )
        lying = [name for name, upright in zip(recordings.clips, recordings.upright) if upright < _UPRIGHT]
        if len(lying) > _MANY_LYING * len(recordings.clips):
            _LOG.warning(
                "in %d of %d motions bodies do not stand, as in %s: do these people lie, or have the files another "
                "vertical axis? %s", len(lying), len(recordings.clips), lying[0], self.other_axes,
            )  # fmt: skip
        return recordings

    @cached_property
    def _subjects(self) -> Subjects:
        names = self.recordings.subjects
        if self.splits is None:
            return split_by_hash(names, self.split_shares)
        return read_splits(self.splits, names)

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`."""
        settings = {
            "version": self.version,
            "recordings": self.recordings.hash,
            "subjects": dict(self._subjects),
            "shapes": self.shapes,
            "max_beta": float(self.max_beta),
            "genders": self.genders,
            "filters": self.filters.fingerprint,
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    def people(self, split: str) -> list[tuple[str, str]]:
        """See `datamodules.sources.mixed.Peopled`."""
        parts = [subject.rpartition("/") for subject in self._subjects[split]]
        return [(dataset.rpartition("/")[2], name.lstrip("0") or name) for dataset, _, name in parts]

    def rows(self, split: str) -> np.ndarray:
        """The frames of a split before any filter, rows of the table.

        Raises:
            ValueError: There is no such split, or it has no subject.
        """
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        if not self._subjects[split]:
            raise ValueError(f"split: {self.splits} lists no subjects for '{split}'")
        is_in = np.isin(self.recordings.subjects, self._subjects[split])
        return np.flatnonzero(is_in[self.recordings.clip])

    def motion(self, split: str) -> dict[str, int]:
        """See `PoseSource.motion`."""
        rows = self.rows(split)
        clips = np.unique(self.recordings.clip[rows])
        return {
            "subjects": len(self._subjects[split]),
            "clips": len(clips),
            "lying_clips": sum(self.recordings.upright[clip] < _UPRIGHT for clip in clips),
            "frames": len(rows),
            "skipped_files": len(self.recordings.skipped),
        }

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`.

        Raises:
            ValueError: There is no such split, or no frame of it passes the filters.
        """
        key = [seed, SPLITS.index(split) if split in SPLITS else -1]
        table, rows = self.recordings, self._draw(split, num_records, key)
        drawn = [
            draw_shapes(np.random.default_rng([*key, _SHAPES, block]), _BLOCK, self.genders, self.max_beta)
            for block in range(-(-num_records // _BLOCK))
        ]
        gender = np.concatenate([shape.gender for shape in drawn] or [np.empty(0, np.int64)])[:num_records]
        betas = np.concatenate([shape.betas for shape in drawn] or [np.empty((0, 10))])[:num_records]
        if self.shapes == "recorded":
            gender, betas = self._recorded(rows, Shapes(gender, betas))
        return PoseRecords(
            np.array(table.pose[rows]),
            betas.astype(np.float32),
            gender,
            np.array(table.clips)[table.clip[rows]],
            np.array(table.frame[rows]),
            has_heading=True,
        )

    def _recorded(self, rows: np.ndarray, drawn: Shapes) -> Shapes:
        """The recorded genders and shapes of rows, drawn ones where there are none or there is no such body."""
        gender, betas = self.recordings.gender[rows], self.recordings.betas[rows].astype(np.float64)
        is_known = np.isin(gender, [GENDERS[name] for name in self.genders])
        return Shapes(
            np.where(is_known, gender, drawn.gender),
            np.where(np.isfinite(betas).all(1)[:, None], betas, drawn.betas),
        )

    def _draw(self, split: str, number: int, key: list[int]) -> np.ndarray:
        """Rows of a split that pass the filters, in random order, each once before any twice: `(number,)`."""
        rows, passing = self.rows(split), np.empty(0, np.int64)
        chosen: list[np.ndarray] = []
        num_chosen, rounds = 0, 0
        while num_chosen < number:
            left = passing if rounds else rows  # the first round has seen all of them
            order = np.random.default_rng([*key, _ORDER, rounds]).permutation(left)
            found: list[np.ndarray] = []
            for start in range(0, len(order), _BLOCK):
                block = order[start : start + _BLOCK]
                if rounds == 0:
                    block = block[self.filters.takes(self.recordings.pose[block])]
                found.append(block)
                num_chosen += len(block)
                if num_chosen >= number:
                    break
            if not num_chosen:
                raise ValueError(
                    f"data.source: none of the {len(rows)} {split} frames passes the filters ({self.filters}); "
                    "allow more"
                )
            chosen += found
            if rounds == 0:
                passing = np.sort(np.concatenate(found))
            rounds += 1
        return np.concatenate([*chosen, np.empty(0, np.int64)])[:number].astype(np.int64)
