"""Reading motion clips and which split each belongs to."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from datamodules.sources import SPLITS
from ljn.body.skeleton import NUM_JOINTS
from ljn.reading import READ_ERRORS, read_arrays, read_json, reason, shown


class Clips(NamedTuple):
    """Frames of motion clips."""

    poses: np.ndarray  # `(N, 72)` float32 axis-angle, radians, in SMPL's axes (y up, z forward)
    clip: np.ndarray  # `(N,)` str, each frame's clip


def read_clips(path: Path) -> Clips:
    """The clips of an `.npz` file with `poses` `(N, 72)` and `clip` `(N,)` names.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged, or holds something else.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"poses: no file {path}; leave `path` out to use the embedded clips, or name the kind of your data "
            "(data/source=amass, bvh, npz, surreal)"
        )
    try:
        arrays = read_arrays(path, ("poses", "clip"))
        poses, clip = arrays["poses"].astype(np.float32), arrays["clip"].astype(str)
    except READ_ERRORS as error:
        raise ValueError(
            f"poses: {path} cannot be read ({reason(error)}); expected an .npz file with `poses` (N, 72) and `clip` "
            "(N,) names"
        ) from error
    if poses.ndim != 2 or poses.shape[1] != 3 * NUM_JOINTS or clip.shape != poses.shape[:1]:
        raise ValueError(
            f"poses: {path} holds `poses` of shape {poses.shape} and `clip` of {clip.shape}; expected "
            f"(N, {3 * NUM_JOINTS}) axis-angle values of the 24 SMPL joints and (N,)"
        )
    if not np.isfinite(poses).all():
        raise ValueError(f"poses: {path} holds NaN or infinite values; drop or repair those frames")
    return Clips(poses, clip)


def read_split(path: Path, clips: Clips) -> dict[str, list[str]]:
    """The clips of each split, from a JSON file.

    It has a list of clips for each of `SPLITS`, or several lists under the names of their strata.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is no such table, or names a clip that there is not, or one twice.
    """
    if not path.is_file():
        raise FileNotFoundError(f"poses: no split file {path}")
    try:
        table = read_json(path)
    except READ_ERRORS as error:
        raise ValueError(f"poses: {path} is no JSON file ({reason(error)})") from error
    table = table if isinstance(table, dict) else {}
    lists = {name: _joined(table.get(name)) for name in SPLITS}
    split = {name: names for name, names in lists.items() if names is not None}
    if len(split) < len(SPLITS):
        raise ValueError(
            f"poses: {path} must hold a list of clips, or strata with such lists, for each of {', '.join(SPLITS)}"
        )
    named = Counter(clip for name in SPLITS for clip in split[name])
    unknown = sorted(named.keys() - set(clips.clip.tolist()))
    twice = sorted(clip for clip, count in named.items() if count > 1)
    if unknown or twice:
        raise ValueError(
            f"poses: {path} must list each clip under one of {', '.join(SPLITS)}; unknown clips: "
            f"{shown(unknown) if unknown else 'none'}, clips named twice: {shown(twice) if twice else 'none'}"
        )
    return split


def _joined(entry: object) -> list[str] | None:
    """The clips of a list or of a table of lists; None for anything else."""
    joined: list[str] = []
    for names in entry.values() if isinstance(entry, dict) else [entry]:
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return None
        joined += names
    return joined
