"""Poses of several sources, mixed by weight."""

import hashlib
import logging
import math
from collections.abc import Iterable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from datamodules.sources import SPLITS, PoseRecords, PoseSource
from ljn.body import GENDERS
from ljn.reading import brief

_LOG = logging.getLogger(__name__)

_CHOICE = 2  # of random streams; the sources draw from theirs


@runtime_checkable
class Peopled(Protocol):
    """A source that says whom it shows."""

    def people(self, split: str) -> Iterable[tuple[str, str]]:
        """Each person of a split: the data set, such as `CMU`, or nothing, and the name in it, without zeros before."""


class MixedSource:
    """Records of several sources; which of them a record is from is drawn by their weights.

    The first record from a source is the first that it yields by itself, and so on. Headings are kept where all sources
    have them, and dropped otherwise. Sources whose weight is 0 are left alone: their files need not be there.

    Args:
        sources: The sources by name.
        weights: How often records are of each, relative to each other; 0 for one that is left out here.
    """

    name = "mixed"
    version = 1

    def __init__(self, sources: Mapping[str, PoseSource], weights: Mapping[str, float]) -> None:
        if set(weights) - set(sources):
            raise ValueError(f"weights: expected some of {', '.join(sources)}, got {dict(weights)}")
        if not all(0 <= weight < math.inf for weight in weights.values()) or not any(weights.values()):
            raise ValueError(
                f"weights: expected numbers of 0 or more, not all 0, got {dict(weights)}; write "
                "data.source.weights.NAME=NUMBER"
            )
        self.sources = {name: sources[name] for name in sorted(weights) if weights[name] > 0}
        total = sum(weights.values())
        self.weights = {name: weights[name] / total for name in self.sources}

    @property
    def cache_dir(self) -> Path | None:
        """See `PoseSource`."""
        return next(iter(self.sources.values())).cache_dir

    @cache_dir.setter
    def cache_dir(self, directory: Path | None) -> None:
        for source in self.sources.values():
            source.cache_dir = directory

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`."""
        parts = [
            f"{name} {weight} {self.sources[name].version} {self.sources[name].fingerprint}"
            for name, weight in self.weights.items()
        ]
        return hashlib.sha256(f"{self.version} {parts}".encode()).hexdigest()[:16]

    @property
    def licence(self) -> str:
        """See `PoseSource.licence`."""
        return "; ".join(f"{name}: {source.licence}" for name, source in self.sources.items())

    @property
    def genders(self) -> tuple[str, ...]:
        """See `PoseSource.genders`."""
        wanted = {gender for source in self.sources.values() for gender in source.genders}
        return tuple(gender for gender in GENDERS if gender in wanted)

    def check(self) -> None:
        """See `PoseSource.check`; also warns of people whom two sources show, in different splits."""
        for name, source in self.sources.items():
            try:
                source.check()
            except (FileNotFoundError, ValueError) as error:
                text = str(error).replace("data.source.", f"data.source.sources.{name}.")
                raise type(error)(text) from error
        self._warn_of_people_in_several_splits()

    def _warn_of_people_in_several_splits(self) -> None:
        shown_by = [
            (split, name, *person)
            for name, source in self.sources.items()
            if isinstance(source, Peopled)
            for split in SPLITS
            for person in source.people(split)
        ]
        places: dict[str, list[tuple[str, str, str]]] = {}
        for split, name, dataset, person in sorted(shown_by):
            places.setdefault(person, []).append((split, name, dataset))
        doubtful = [
            f"{person} ({name}: {split}, {other}: {other_split})"
            for person, rows in sorted(places.items())
            for (split, name, dataset), (other_split, other, other_dataset) in combinations(rows, 2)
            if name != other
            and split != other_split
            and (dataset == other_dataset or not (dataset and other_dataset))
        ]
        if doubtful:
            _LOG.warning(
                "people of the same name are in different splits of two sources: %s; if they are the same, give each "
                "source a file of splits, data.source.sources.NAME.splits=FILE.yaml",
                brief(f"{len(doubtful)}, such as {', '.join(doubtful)}"),
            )

    def motion(self, split: str) -> dict[str, int]:
        """The sources' own, with their names before a dot; see `PoseSource.motion`."""
        return {
            f"{name}.{key}": count
            for name, source in self.sources.items()
            for key, count in source.motion(split).items()
        }

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        rng = np.random.default_rng([seed, SPLITS.index(split), _CHOICE])
        edges = np.cumsum(list(self.weights.values()))
        which = np.searchsorted(edges[:-1], rng.random(num_records), side="right")
        parts = [
            source.records(split, int((which == index).sum()), seed)
            for index, source in enumerate(self.sources.values())
        ]
        has_heading = all(part.has_heading for part in parts)
        if not has_heading:
            parts = [part.without_heading() for part in parts]
        place = np.argsort(
            np.argsort(which, kind="stable")
        )  # of each record among those of all parts in a row
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts])[place]
            for name in ("pose", "betas", "gender", "sequence", "frame")
        }
        return PoseRecords(**columns, has_heading=has_heading)
