"""Which split each recorded person belongs to: a person is in one alone."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from datamodules.sources import SPLITS
from ljn.reading import READ_ERRORS, read_yaml, reason, shown

Subjects = Mapping[str, tuple[str, ...]]
"""For each of `SPLITS` its subjects."""


def check_shares(shares: Sequence[float]) -> None:
    """Raise a `ValueError` unless there is a share for each of `SPLITS`."""
    if len(shares) != len(SPLITS) or not all(0 < share < 1 for share in shares) or sum(shares) > 1 + 1e-6:
        raise ValueError(
            f"split_shares: expected shares of {', '.join(SPLITS)}, each more than 0, 1 in sum, as in [0.8, 0.1, 0.1]; "
            f"got {list(shares)}"
        )


def split_by_hash(subjects: Sequence[str], shares: Sequence[float]) -> Subjects:
    """Subjects in the order of their names' hashes: the first are for testing, then validation, the rest training.

    A split is full when it has its share of the clips, so that it does not hang on how many frames of them are taken.
    Each has at least one subject.

    Args:
        subjects: Each clip's subject.
        shares: Of train, validation and test.

    Raises:
        ValueError: There are fewer subjects than splits.
    """
    names = sorted(set(subjects), key=lambda name: hashlib.sha256(name.encode()).digest())
    if len(names) < len(SPLITS):
        raise ValueError(
            f"data.source.splits: expected {len(SPLITS)} subjects or more to split, got {len(names)} "
            f"({shown(names)}); say which split is whose in a file, data.source.splits=FILE.yaml, such as "
            "'test: [\"*\"]'"
        )
    counts = Counter(subjects)
    parts: dict[str, list[str]] = {split: [] for split in SPLITS}
    for later, split in enumerate(reversed(SPLITS[1:])):
        left_for_others = len(SPLITS) - 1 - later
        share = shares[SPLITS.index(split)] * len(subjects)
        while not parts[split] or (
            sum(counts[name] for name in parts[split]) < share and len(names) > left_for_others
        ):
            parts[split].append(names.pop(0))
    parts[SPLITS[0]] = names
    return {split: tuple(sorted(part)) for split, part in parts.items()}


def read_splits(path: Path, subjects: Sequence[str]) -> Subjects:
    """The subjects of each split by a YAML file: for some of `SPLITS` a list of names, or of patterns with `*`.

    A name counts before a pattern. Subjects that nothing names are in no split.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no such table, names subjects that there are not, or a subject in two splits.
    """
    where = f"data.source.splits: {path}"
    if not path.is_file():
        raise FileNotFoundError(f"data.source.splits: no file {path}; null splits by a hash of the subjects")
    try:
        table = read_yaml(path)
    except READ_ERRORS as error:
        raise ValueError(f"{where} is no YAML file ({reason(error)})") from error
    if not isinstance(table, dict) or not table or set(table) - set(SPLITS):
        raise ValueError(
            f"{where}: expected lists of subjects under some of {', '.join(SPLITS)}, got {shown(table)}"
        )
    known = set(subjects)
    of_name: dict[str, set[str]] = {}
    of_pattern: dict[str, set[str]] = {}
    for split, entries in table.items():
        if not isinstance(entries, list) or not all(isinstance(entry, str | int) for entry in entries):
            raise ValueError(f"{where}: expected a list of subjects under {split}, got {shown(entries)}")
        for entry in map(str, entries):
            if entry in known:
                of_name.setdefault(entry, set()).add(split)
                continue
            found = [name for name in known if fnmatchcase(name, entry)]
            if not found:
                raise ValueError(
                    f"{where}: {split} names {shown(entry)}, which no subject is; there are "
                    f'{shown(sorted(known))} (names of digits in quotes: "01")'
                )
            for name in found:
                of_pattern.setdefault(name, set()).add(split)
    splits = of_pattern | of_name
    if twice := sorted(name for name, places in splits.items() if len(places) > 1):
        raise ValueError(f"{where}: a subject is in one split alone, but {shown(twice)} are in several")
    return {
        split: tuple(sorted(name for name, (place,) in splits.items() if place == split)) for split in SPLITS
    }
