"""Reading a BVH file: a skeleton and its joints' angles, frame by frame."""

import codecs
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ljn.geometry.rotations import euler_to_rotmat, rotation_about
from ljn.reading import shown

_MAX_BYTES = 2**29
_MAX_JOINTS = 1000
_MAX_VALUE = 1e7  # of any unit or winding of degrees
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)
_MOTION = re.compile(r"^[ \t]*MOTION[ \t]*$", re.MULTILINE | re.IGNORECASE)
_HEADER = re.compile(r"\s*Frames\s*:\s*(\S+)\s*Frame\s*Time\s*:\s*(\S+)[ \t]*\n?", re.IGNORECASE)


class BvhFile(NamedTuple):
    """A skeleton of J joints, parents before children, and T frames of it, in the file's own axes and unit."""

    names: tuple[str, ...]
    parents: tuple[int, ...]  # -1 for the root
    offsets: np.ndarray  # `(J, 3)`, from the parent, at rest
    channels: tuple[tuple[str, ...], ...]  # of each joint, such as `Zrotation`, in order
    frames: np.ndarray  # `(T, C)`, all channels' values: units of length and degrees
    rate_hz: float | None  # None where the file does not say it
    notes: tuple[str, ...]  # what was wrong and could be passed over


def read_bvh(path: Path) -> BvhFile:
    """Read a BVH file, with tabs or blanks, any line ends, and points or commas in its numbers.

    Frames that are not whole, or hold what is no number, are left out, and the number of frames is that of the lines
    which are there: `notes` says so.

    Raises:
        ValueError: It is no BVH file, or damaged; the message says where.
        OSError: It cannot be read.
    """
    if (size := path.stat().st_size) > _MAX_BYTES:
        raise ValueError(f"{size} bytes, expected at most {_MAX_BYTES}")
    content = path.read_bytes()
    text = _decoded(content)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    parts = _MOTION.split(text)
    if len(parts) != 2:
        raise ValueError(f"MOTION: expected this line of a BVH file once, got it {len(parts) - 1} times")
    names, parents, offsets, channels = _hierarchy(parts[0])
    frames, rate, notes = _motion(parts[1], sum(map(len, channels)))
    return BvhFile(names, parents, offsets, channels, frames, rate, notes)


def _decoded(content: bytes) -> str:
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16" if is_wide else "utf-8-sig", "latin-1"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise AssertionError("latin-1 has every byte")


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Each line's number and words, with braces in lines of their own."""
    for number, line in enumerate(text.split("\n"), 1):
        if line.lstrip().startswith(("#", "//")):
            continue
        for part in re.split(r"([{}])", line):
            if words := part.split():
                yield number, words


def _hierarchy(
    text: str,
) -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray, tuple[tuple[str, ...], ...]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: dict[int, np.ndarray] = {}
    channels: dict[int, tuple[str, ...]] = {}
    open_joints: list[int | None] = []  # None for an end site
    pending: int | None = None
    for line, words in _statements(text):
        keyword, where = words[0].upper(), f"HIERARCHY, line {line}"
        here = open_joints[-1] if open_joints else None
        if keyword in ("ROOT", "JOINT"):
            if (keyword == "ROOT") != (not names) or (names and here is None):
                raise ValueError(f"{where}: {keyword} in a wrong place; expected one ROOT, and JOINTs in it")
            if len(words) < 2 or len(names) >= _MAX_JOINTS:
                raise ValueError(f"{where}: expected a name after {keyword}, of at most {_MAX_JOINTS} joints")
            parents.append(-1 if here is None else here)
            pending = len(names)
            names.append(" ".join(words[1:]))
        elif keyword in ("END", "ENDSITE"):
            pending = None
        elif keyword == "{":
            open_joints.append(pending)
            pending = None
        elif keyword == "}":
            if not open_joints:
                raise ValueError(f"{where}: a }} too many")
            open_joints.pop()
        elif keyword == "OFFSET":
            values = _numbers(words[1:])
            if values is None or len(values) != 3:
                raise ValueError(f"{where}: OFFSET: expected three numbers, got {shown(' '.join(words[1:]))}")
            if here is not None:
                offsets[here] = values
        elif keyword == "CHANNELS" and here is not None:
            matches = [_CHANNEL.fullmatch(word) for word in words[2:]]
            if words[1:2] != [str(len(matches))] or not all(matches):
                raise ValueError(
                    f"{where}: CHANNELS: expected their number and as many of Xposition, ..., Zrotation, got "
                    f"{shown(' '.join(words[1:]))}"
                )
            channels[here] = tuple(f"{match[1].upper()}{match[2].lower()}" for match in matches if match)
        elif keyword != "HIERARCHY":
            raise ValueError(
                f"{where}: expected a joint, OFFSET, CHANNELS, End Site or a brace, got {shown(words[0])}"
            )
    if open_joints or not names:
        raise ValueError("HIERARCHY: a } is missing, or there is no ROOT")
    if missing := [name for joint, name in enumerate(names) if joint not in offsets]:
        raise ValueError(f"HIERARCHY: joint {shown(missing[0])} has no OFFSET")
    of_joints = tuple(channels.get(joint, ()) for joint in range(len(names)))
    return tuple(names), tuple(parents), np.stack([offsets[joint] for joint in range(len(names))]), of_joints


def _numbers(words: list[str]) -> np.ndarray | None:
    """Finite numbers, with points or commas; None where one is no number."""
    try:
        values = np.array([float(word.rstrip(",").replace(",", ".")) for word in words])
    except ValueError:
        return None
    return values if (np.abs(values) <= _MAX_VALUE).all() else None


def _motion(text: str, width: int) -> tuple[np.ndarray, float | None, tuple[str, ...]]:
    match = _HEADER.match(text)
    if match is None:
        raise ValueError("MOTION: expected 'Frames: N' and 'Frame Time: SECONDS' after it")
    if width == 0:
        raise ValueError("CHANNELS: no joint has any")
    notes = []
    time = _numbers([match[2]])
    rate = None if time is None or not 1e-5 < time[0] < 2 else float(1 / time[0])
    if rate is None:
        notes.append(f"Frame Time: expected seconds, got {shown(match[2])}, so all frames count")
    body = text[match.end() :]
    # A comma is a decimal one only where there are no points.
    body = body.replace(",", " " if "." in body else ".")
    # As text: words take ten times the memory of their numbers.
    rows = [line for line in body.split("\n") if line.strip()]
    lengths = [len(line.split()) for line in rows]
    whole = [line for line, length in zip(rows, lengths) if length == width]
    if not whole and match[1].isdecimal() and sum(lengths) == int(match[1][:9]) * width:
        words = body.split()  # lines that end within a frame
        whole = rows = [" ".join(words[start : start + width]) for start in range(0, len(words), width)]
    if not whole:
        got = f"{len(rows)} lines, the first of {lengths[0]} numbers" if rows else "none"
        raise ValueError(f"MOTION: expected lines of {width} numbers, got {got}")
    frames = _table(whole, width)
    is_right = (np.abs(frames) <= _MAX_VALUE).all(1)
    if not is_right.any():
        raise ValueError(f"MOTION: NaN, or what is no number, in all {len(frames)} frames")
    if match[1] != str(len(rows)):
        notes.append(f"Frames: {shown(match[1])} by the file, {len(rows)} lines are there")
    if (lost := len(rows) - int(is_right.sum())) > 0:
        notes.append(f"MOTION: {lost} of {len(rows)} frames are not {width} numbers, left out")
    return frames[is_right], rate, tuple(notes)


def _table(lines: list[str], width: int) -> np.ndarray:
    """Numbers of lines of `width` words; NaN in all of a line where one is no number."""
    values = np.full((len(lines), width), np.nan)
    for row, line in enumerate(lines):
        words = line.split()
        try:
            values[row] = list(map(float, words))
        except ValueError:
            if (numbers := _numbers(words)) is not None:
                values[row] = numbers
    return values


def joint_transforms(bvh: BvhFile, rows: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Each joint's rotation `(T, J, 3, 3)` into the file's world, and its position `(T, J, 3)`, of some frames.

    A joint with channels of position stands there relative to its parent, instead of at its offset.
    """
    frames, place = torch.from_numpy(bvh.frames[rows]), 0
    rotations: list[torch.Tensor] = []
    positions: list[torch.Tensor] = []
    for joint, parent in enumerate(bvh.parents):
        names = bvh.channels[joint]
        values = frames[:, place : place + len(names)]
        place += len(names)
        turns = [
            (name[0].lower(), values[:, k].deg2rad())
            for k, name in enumerate(names)
            if name[1:] == "rotation"
        ]
        local = _product(turns, len(frames))
        offset = torch.from_numpy(bvh.offsets[joint]).repeat(len(frames), 1)
        for k, name in enumerate(names):
            if name[1:] == "position":
                offset[:, "XYZ".index(name[0])] = values[:, k]
        if parent < 0:
            rotations.append(local)
            positions.append(offset)
        else:
            rotations.append(rotations[parent] @ local)
            positions.append(positions[parent] + (rotations[parent] @ offset[..., None]).squeeze(-1))
    return torch.stack(rotations, 1), torch.stack(positions, 1)


def _product(turns: list[tuple[str, torch.Tensor]], number: int) -> torch.Tensor:
    """The rotations `(T, 3, 3)` of turns about axes, one after the other."""
    axes = "".join(axis for axis, _ in turns)
    if sorted(axes) == ["x", "y", "z"]:
        return euler_to_rotmat(axes, torch.stack([angle for _, angle in turns], -1))
    product = torch.eye(3, dtype=torch.float64).repeat(number, 1, 1)
    for axis, angle in turns:
        product = product @ rotation_about(axis, angle)
    return product
