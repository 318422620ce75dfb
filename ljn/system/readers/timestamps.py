"""Times of a recording's frames: read, checked, and matched with those of another camera."""

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ljn.reading import READ_ERRORS, brief, reason

MATCH_S = 0.02
"""Images of two cameras that were taken within so many seconds belong together."""
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LONGEST_S = 5.0  # between two frames as a rule; more is probably another unit
_JUMP = 5.0  # times the usual interval
_MAX_BYTES = 2**24
_LINE = re.compile(r"(?:(.*?)[,;\s]+)?([^,;\s]*)")
_HEADER = re.compile(r"(?:time|timestamp)s?(?:_(s|ms|us|ns))?", re.IGNORECASE)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file that are neither empty nor begin with `#`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no text, or too large.
    """
    if not path.is_file():
        raise FileNotFoundError(f"input: no file '{path}'")
    try:
        if (size := path.stat().st_size) > _MAX_BYTES:
            raise ValueError(f"{size} bytes, expected at most {_MAX_BYTES}")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except READ_ERRORS as error:
        raise ValueError(f"input: '{path}' cannot be read ({reason(error)}); write it again") from error
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_timestamps(path: Path, names: Sequence[str]) -> tuple[list[float | None], str]:
    """A time for each of the frames called `names`, seconds, None where the file has none; and a remark, or "".

    Its lines are `NAME,SECONDS`, or seconds alone, one for each frame in order. A first line may name the columns:
    `name,timestamp_s`, or `timestamp_ms`, `_us`, `_ns`.

    Raises:
        ValueError: It cannot be read, a time is no number, or the times are in another unit than they say.
    """
    rows = [_LINE.fullmatch(line.rstrip(",; ")) for line in read_lines(path)]
    lines = [(row[1], row[2]) for row in rows if row]
    factor, is_named = 1.0, False
    if lines and (header := _HEADER.fullmatch(lines[0][1])):
        is_named = bool(header[1])
        factor = _UNITS[(header[1] or "s").lower()]
        lines = lines[1:]
    numbers = [_number(text, path) for _, text in lines]
    times = [None if time is None else time * factor for time in numbers]
    known = [time for time in times if time is not None]
    if not is_named and len(known) > 1 and abs(np.median(np.diff(known))) > _LONGEST_S:
        raise ValueError(
            f"timestamps: expected seconds in '{path}', got {known[0]:g}, {known[1]:g}, ...: name their unit in a "
            "first line, such as name,timestamp_ms"
        )
    # As a name: the file's, with or without its folder and suffix.
    of_name = dict(zip((name for name, _ in lines), times)) | {
        Path(name).stem: time for (name, _), time in zip(lines, times) if name
    }
    if any(name in of_name for name in names):
        found = [of_name.get(name) for name in names]
        missing = found.count(None)
        return found, f"'{path.name}' has no time for {missing} of {len(names)} frames" if missing else ""
    if len(times) != len(names):
        remark = f"'{path.name}' has {len(times)} times for {len(names)} frames, and names none: left out"
        return [None] * len(names), remark
    return times, ""


def _number(text: str, path: Path) -> float | None:
    if text.lower() in ("", "nan", "none", "null"):
        return None
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"timestamps: expected lines NAME,SECONDS in '{path}', got '{brief(text)}'")
    return number


def since_first(times: Sequence[float | None]) -> tuple[list[float | None], dict[str, object]]:
    """Seconds since the first frame; None where the clock went back. And facts: how often it did, and jumped ahead."""
    first, latest = None, -math.inf
    found: list[float | None] = []
    num_back = 0
    for time in times:
        if time is not None and time <= latest:
            num_back += 1
            time = None
        if time is not None:
            first = time if first is None else first
            latest = time
        found.append(None if time is None or first is None else time - first)
    known = [time for time in found if time is not None]
    steps = np.diff(known)
    num_jumps = int(np.count_nonzero(steps > _JUMP * np.median(steps))) if len(steps) else 0
    facts = {"times_that_go_back": num_back, "jumps_in_time": num_jumps}
    return found, {key: count for key, count in facts.items() if count}


def frames_a_second(times: Sequence[float | None]) -> float | None:
    """From the usual interval between neighbouring frames; None where times are not known."""
    steps = [b - a for a, b in pairwise(times) if a is not None and b is not None]
    return round(float(1 / np.median(steps)), 3) if steps else None


def match(times: Sequence[float], others: Sequence[float], within_s: float = MATCH_S) -> list[int | None]:
    """For each time the place of the other time that belongs to it, None for none; each is taken once.

    Of several that are nearest to the same other, the nearest takes it. Neither has to be sorted.
    """
    found: list[int | None] = [None] * len(times)
    if not len(others):
        return found
    order = np.argsort(others, kind="stable")
    ordered = np.asarray(others, np.float64)[order]
    wanted = np.asarray(times, np.float64)
    right = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    left = np.maximum(right - 1, 0)
    place = np.where(np.abs(ordered[left] - wanted) <= np.abs(ordered[right] - wanted), left, right)
    distance = np.abs(ordered[place] - wanted)
    taken = set()
    for i in np.argsort(distance, kind="stable"):
        if distance[i] <= within_s and place[i] not in taken:
            taken.add(place[i])
            found[i] = int(order[place[i]])
    return found
