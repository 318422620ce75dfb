"""SURREAL's poses and shapes, by the thesis's protocol (section 3.5.1, Table 3.1)."""

import hashlib
import json
import logging
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from tqdm import tqdm

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.surreal.check import examine_clips
from datamodules.sources.surreal.files import INFO, read_clip
from datamodules.sources.surreal.index import ClipEntry, find_tree, normalised, read_index
from ljn.body import GENDERS, BodyModel
from ljn.data import Finding

_LOG = logging.getLogger(__name__)
MONSTROUS = ("18", "19", "143_21")
"""Subjects, and a sequence, whose shapes are no people's."""
_OF_SURREAL = ("female", "male")


class SurrealSource:
    """Frames of SURREAL's clips, as they stand in its files: poses with their headings, shapes, genders.

    A record is a frame of a clip of more than five frames of one run; each clip that has a part gives at least three
    of its frames, all as nearly the same number as their lengths allow. Of fewer records than that makes, as many clips
    as there is room for have a part, drawn at random; where there are more than frames, frames come again.

    The validation set is drawn from the tree's `val`, whose clips are among those of `test`, as the thesis has it;
    without that folder, from `test`. No subject of either is in training: clips of a subject who is in both are left
    out there.

    What cannot be read, frame or file, is named, counted and left out.

    Args:
        path: The folder that has `cmu` in it, or that one itself.
        run: Of the runs with different overlaps of clips, which one.
        min_frames: Clips of fewer frames have no part.
        samples_per_clip: Frames of a clip that has a part, at least.
        skip: Subjects and sequences that are left out.
        genders: The bodies that there are, keys of `ljn.body.GENDERS`: `female` and `male`, each for its own records,
            or a single one for all.
    """

    name = "surreal"
    version = 1
    cache_dir: Path | None = None
    files: tuple[str, ...] = (INFO,)
    """What a clip has to have, by the ends of its files' names."""
    licence = (
        "SURREAL (Varol et al., CVPR 2017), the user's own copy, licensed for non-commercial research: "
        "https://www.di.ens.fr/willow/research/surreal/data"
    )

    def __init__(
        self,
        path: str | Path | None = None,
        run: str = "run0",
        min_frames: int = 6,
        samples_per_clip: int = 3,
        skip: Sequence[str] = MONSTROUS,
        genders: Sequence[str] = _OF_SURREAL,
    ) -> None:
        if not 1 <= samples_per_clip <= min_frames:
            raise ValueError(
                f"samples_per_clip: expected 1 to min_frames, {min_frames}, so that each comes of another frame, got "
                f"{samples_per_clip}"
            )
        if set(genders) - set(GENDERS) or not (len(genders) == 1 or set(_OF_SURREAL) <= set(genders)):
            raise ValueError(
                f"genders (body.genders): expected female and male, or one of {', '.join(GENDERS)} for all records, "
                f"got {list(genders)}"
            )
        self.path = Path(path) if path is not None else None
        self.run = run
        self.min_frames = min_frames
        self.samples_per_clip = samples_per_clip
        self.skip = tuple(normalised(str(each)) for each in skip)
        self.genders = tuple(genders)

    def check(self) -> None:
        """Read the index, or make it; see `PoseSource.check`."""
        _ = self._parts

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`; of the content of all clips that may have a part, wherever they lie."""
        settings = [self.version, self.run, self.samples_per_clip, self.genders]
        digest = hashlib.sha256(json.dumps(settings).encode())
        for split in SPLITS:
            for entry in self._parts[split]:
                digest.update(f"{split} {entry.name} {entry.content}\n".encode())
        return digest.hexdigest()[:16]

    @cached_property
    def tree(self) -> Path:
        """The folder that has the splits' folders in it."""
        return find_tree(self.path, self.run)

    @cached_property
    def entries(self) -> list[ClipEntry]:
        """All clips of the tree."""
        return read_index(self.tree, self.run, self.cache_dir)

    @cached_property
    def _parts(self) -> dict[str, list[ClipEntry]]:
        """The clips that may have a part, by split."""
        usable = [entry for entry in self.entries if self._is_usable(entry)]
        parts = {split: [entry for entry in usable if entry.split == split] for split in SPLITS}
        parts["val"] = parts["val"] or parts["test"]
        held_out = {entry.subject for split in ("val", "test") for entry in parts[split]}
        shared = {entry.subject for entry in parts["train"]} & held_out
        if shared:
            _LOG.warning(
                "SURREAL: subjects %s are in training and test; their clips are left out of training",
                ", ".join(sorted(shared)),
            )
            parts["train"] = [entry for entry in parts["train"] if entry.subject not in shared]
        if not any(parts.values()):
            raise ValueError(
                f"data.source.path: of {len(self.entries)} clips in {self.tree} none has {self.min_frames} frames or "
                f"more, all of its files ({self._named_files}), and a subject that is not skipped "
                "(data.source.skip)"
            )
        for split in SPLITS:
            if not parts[split]:
                _LOG.warning("SURREAL: %s", self._nothing_for(split))
        return parts

    @property
    def _named_files(self) -> str:
        return ", ".join(f"*{end}" for end in self.files)

    def _nothing_for(self, split: str) -> str:
        """Why a split has no clip."""
        folders = [self.tree / part / self.run for part in (("val", "test") if split == "val" else (split,))]
        names = " or ".join(map(str, folders))
        if not any(folder.is_dir() for folder in folders):
            return f"no clip for '{split}': there is no {names}; download this part of SURREAL, too"
        return (
            f"no usable clip for '{split}' in {names}: all are too short, damaged, skipped, of subjects of the test "
            f"set, or not whole ({self._named_files})"
        )

    def _is_usable(self, entry: ClipEntry) -> bool:
        is_skipped = entry.subject in self.skip or entry.sequence in self.skip
        num_good = entry.num_frames - len(entry.bad_frames)
        return not is_skipped and entry.num_frames >= self.min_frames and num_good >= self.samples_per_clip

    def examine(self, bodies: Sequence[BodyModel], num_clips: int | None) -> Iterator[Finding]:
        """See `Examinable`: cameras and bodies, of clips of all splits."""
        yield from examine_clips(self.tree, self.entries, bodies, num_clips)

    def people(self, split: str) -> list[tuple[str, str]]:
        """See `datamodules.sources.mixed.Peopled`: CMU's subjects."""
        return sorted({("CMU", str(entry.subject).lstrip("0")) for entry in self._parts[split]})

    def motion(self, split: str) -> dict[str, int]:
        """See `PoseSource.motion`: also subjects and sequences, and the files of the split that cannot be read."""
        clips = self._parts[split]
        return {
            "clips": len(clips),
            "frames": sum(len(entry.good_frames) for entry in clips),
            "subjects": len({entry.subject for entry in clips}),
            "sequences": len({entry.sequence for entry in clips}),
            "damaged": sum(bool(entry.problem) for entry in self.entries if entry.split == split),
        }

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        draws, order = (np.random.default_rng([seed, SPLITS.index(split), purpose]) for purpose in range(2))
        chosen = self._drawn(split, num_records, draws)
        parts = [
            self._columns(entry, frames)
            for entry, frames in tqdm(chosen, desc=f"{split} poses", unit="clip", disable=None, leave=False)
        ]
        pose, betas, gender, sequence, frame = (np.concatenate(column) for column in zip(*parts))
        if not len(pose):
            raise ValueError(
                f"data.source.path: of {len(chosen)} clips drawn for '{split}', none can be used"
            )
        # In random order, so that the first ones are of all kinds; some again where others could not be used.
        rows = order.permutation(len(pose))
        if missing := num_records - len(rows):
            _LOG.warning(
                "SURREAL: %d of %d samples of %s come twice, for others", missing, num_records, split
            )
            rows = np.concatenate([rows, order.choice(rows, missing)])
        pose, betas, gender, sequence, frame = (each[rows] for each in (pose, betas, gender, sequence, frame))
        if len(self.genders) == 1:
            gender = np.full_like(gender, GENDERS[self.genders[0]])
        return PoseRecords(pose, betas, gender, sequence, frame.astype(np.int64), has_heading=True)

    def _columns(self, entry: ClipEntry, frames: np.ndarray) -> tuple[np.ndarray, ...]:
        """The columns of a clip's frames, but for `has_heading`."""
        path = self.tree / f"{entry.name}{INFO}"
        try:
            clip = read_clip(path)
            if len(clip) != entry.num_frames:
                raise ValueError(f"{path}: {len(clip)} frames, expected {entry.num_frames}")
        except (ValueError, OSError) as error:
            raise ValueError(
                f"{error} (it was otherwise when the tree was indexed: has it changed?)"
            ) from error
        sequence = np.full(len(frames), entry.name)
        return clip.pose[frames], clip.betas[frames], clip.gender[frames], sequence, frames

    def _drawn(
        self, split: str, num_records: int, rng: np.random.Generator
    ) -> list[tuple[ClipEntry, np.ndarray]]:
        """The clips that have a part, ordered by name, and of each the frames, ascending."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        clips = self._parts[split]
        if not clips:
            raise ValueError(f"data.source.path: {self._nothing_for(split)}")
        number = min(len(clips), max(1, num_records // self.samples_per_clip))
        chosen = np.sort(rng.permutation(len(clips))[:number])
        frames = [clips[i].good_frames for i in chosen]
        shares = even_shares(np.array([len(each) for each in frames]), num_records, rng)
        if sum(map(len, frames)) < num_records:
            _LOG.warning(
                "SURREAL: %s has %d frames for %d samples", split, sum(map(len, frames)), num_records
            )
        drawn = []
        for i, each, share in zip(chosen, frames, shares):
            times = -(-share // len(each))
            picked = (
                np.concatenate([rng.permutation(each) for _ in range(times)])[:share] if share else each[:0]
            )
            drawn.append((clips[i], np.sort(picked)))
        return drawn


def even_shares(rooms: np.ndarray, total: int, rng: np.random.Generator) -> np.ndarray:
    """Whole numbers `(n,)` of sum `total`, as equal as possible, each at most its room; all rooms grow if they must.

    Which ones are greater by one than others is drawn.
    """
    rooms = rooms * max(1, -(-total // int(rooms.sum())))
    shares = np.zeros_like(rooms)
    while left := total - int(shares.sum()):
        is_open = rng.permutation(np.flatnonzero(shares < rooms))
        each = max(1, left // len(is_open))
        growing = is_open[: left // each]
        shares[growing] = np.minimum(shares[growing] + each, rooms[growing])
    return shares
