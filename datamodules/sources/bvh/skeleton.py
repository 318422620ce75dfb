"""Which joint of a BVH skeleton each of SMPL's joints follows: small YAML files, some of which ship."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np

from ljn.body.skeleton import JOINT_INDEX
from ljn.reading import READ_ERRORS, read_yaml, reason, shown

_DIRECTORY = Path(__file__).parent / "skeletons"
SHIPPED = ("smpl", "cmu_daz", "cmu_motionbuilder", "mixamo", "lafan1", "truebones", "bandai_namco")
"""The skeletons that ship; of those that fit equally well, the first counts."""
AUTO = "auto"
NEEDED = (
    "pelvis", "spine3", "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle", "l_shoulder", "r_shoulder",
    "l_elbow", "r_elbow", "l_wrist", "r_wrist",
)  # fmt: skip
"""The joints without which there is no pose; what the others do can be guessed."""


@dataclass(frozen=True)
class Skeleton:
    """How a kind of BVH skeleton is to be read.

    Attributes:
        name: Of the skeleton.
        joints: For SMPL's joints, those of `NEEDED` at least, the names that its joint may have in a file.
        skip_frames: Frames at the beginning that show no motion, such as a T-pose.
        rest_frame: The frame that shows the person upright, with straight arms and legs; None where the offsets do.
        same_rest: Whether its bones rest as SMPL's do, so that rotations are SMPL's own.
        rest_axes: For files whose bones all rest along one axis, in a world that is y up: of SMPL's joints, which of
            its joint's axes, in a T-pose, lead to the person's left, up, and forward, such as `z x y`, `-z -x y`. A
            joint without has its parent's.
    """

    name: str
    joints: Mapping[str, tuple[str, ...]]
    skip_frames: int = 0
    rest_frame: int | None = None
    same_rest: bool = False
    rest_axes: Mapping[str, str] = field(default_factory=dict)

    def missing(self, names: Iterable[str]) -> list[str]:
        """The joints that a file with these names does not have, those of `NEEDED` first."""
        places = _places(names)
        missing = [joint for joint, choices in self.joints.items() if not places.keys() & _lower(choices)]
        return sorted(missing, key=lambda joint: joint not in NEEDED)

    def find(self, names: Iterable[str]) -> dict[str, int]:
        """The place among a file's `names` of the joint that each of SMPL's joints follows, where there is one.

        Names count without what a program puts before all of them (`mixamorig:Hips`, `Bip01_Hips`) and without regard
        to case. A joint follows at most one of SMPL's, of `NEEDED` first, and then in the table's order.

        Raises:
            ValueError: One of `NEEDED` is missing, or a name is there twice.
        """
        places = _places(names)
        found: dict[str, int] = {}
        for joint, choices in sorted(self.joints.items(), key=lambda entry: entry[0] not in NEEDED):
            is_free = {name for name, where in places.items() if where[0] not in found.values()}
            name = next((name for name in _lower(choices) if name in is_free), None)
            if name is None:
                if joint in NEEDED:
                    raise ValueError(
                        f"joint {shown(' or '.join(choices))} ({joint}) is missing, or another's"
                    )
                continue
            if len(places[name]) > 1:
                raise ValueError(f"joint {shown(name)} ({joint}) is there {len(places[name])} times")
            [found[joint]] = places[name]
        return found


def _places(names: Iterable[str]) -> dict[str, list[int]]:
    """Where each name stands, in lower case; also without what is before a colon, or before all of them up to a `_`."""
    whole = [name.lower() for name in names]
    bare = [name.rpartition(":")[2] for name in whole]
    common = "".join(one for one, *_ in takewhile(lambda letters: len(set(letters)) == 1, zip(*bare)))
    start = len(re.sub(r"[^_ |]*$", "", common))
    places: dict[str, list[int]] = {}
    for place, (name, short) in enumerate(zip(whole, bare)):
        for key in {name, short, short[start:]}:
            places.setdefault(key, []).append(place)
    return places


def _lower(names: Iterable[str]) -> dict[str, None]:
    """Names in lower case, in their order."""
    return dict.fromkeys(name.lower() for name in names)


def read_skeleton(path: Path) -> Skeleton:
    """Read a table of joints; `docs/data.md` describes it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no such table.
    """
    where = f"data.source.skeleton: {path}"
    if not path.is_file():
        raise FileNotFoundError(
            f"data.source.skeleton: expected {AUTO}, {', '.join(SHIPPED)} or a YAML file, got '{path}'"
        )
    try:
        table: Any = read_yaml(path)
    except READ_ERRORS as error:
        raise ValueError(f"{where} is no YAML file ({reason(error)})") from error
    known = {field.name for field in fields(Skeleton)} - {"name"}
    if not isinstance(table, dict) or set(table) - known or not isinstance(table.get("joints"), dict):
        raise ValueError(
            f"{where}: expected joints, and maybe others of {', '.join(sorted(known))}, got {shown(table)}"
        )
    joints = {}
    for joint, names in table["joints"].items():
        names = [names] if isinstance(names, str) else names
        if (
            joint not in JOINT_INDEX
            or not isinstance(names, list)
            or not all(isinstance(n, str) for n in names)
        ):
            raise ValueError(
                f"{where}: joints: expected names for SMPL's joints, got {shown(joint)}: {shown(names)}"
            )
        joints[joint] = tuple(names)
    if missing := [joint for joint in NEEDED if not joints.get(joint)]:
        raise ValueError(f"{where}: joints: {missing[0]} is missing; needed are {', '.join(NEEDED)}")
    axes = table.get("rest_axes", {})
    if not isinstance(axes, dict) or not all(
        joint in JOINT_INDEX and isinstance(text, str) and axes_of(text) is not None
        for joint, text in axes.items()
    ):
        raise ValueError(
            f"{where}: rest_axes: expected for SMPL's joints the axes that lead left, up and forward, such as 'z x y' "
            f"or '-z -x y', got {shown(axes)}"
        )
    skip, rest, same = table.get("skip_frames", 0), table.get("rest_frame"), table.get("same_rest", False)
    if type(skip) is not int or skip < 0 or not (rest is None or (type(rest) is int and rest >= 0)):
        raise ValueError(
            f"{where}: skip_frames, rest_frame: expected 0 or more, got {shown(skip)} and {shown(rest)}"
        )
    if not isinstance(same, bool):
        raise ValueError(f"{where}: same_rest: expected true or false, got {shown(same)}")
    return Skeleton(path.stem, joints, skip, rest, same, axes)


def axes_of(text: str) -> np.ndarray | None:
    """A joint's rotation `(3, 3)` into the world in a T-pose, of its axes that lead left, up and forward; else None."""
    matches = [re.fullmatch(r"([+-]?)([xyz])", word) for word in text.split()]
    rows = [(1 - 2 * (match[1] == "-")) * np.eye(3)["xyz".index(match[2])] for match in matches if match]
    if len(rows) != 3 or len(matches) != 3 or np.linalg.det(rows) < 0.5:
        return None
    return np.array(rows)


def known_skeletons(choice: str | Path) -> list[Skeleton]:
    """The skeletons that a setting means: those that ship for `auto`, one of them by name, or a file's."""
    if choice == AUTO:
        return [read_skeleton(_DIRECTORY / f"{name}.yaml") for name in SHIPPED]
    return [read_skeleton(_DIRECTORY / f"{choice}.yaml" if choice in SHIPPED else Path(choice))]


def fitting(skeletons: list[Skeleton], names: tuple[str, ...]) -> list[tuple[Skeleton, dict[str, int]]]:
    """The skeletons whose needed joints a file has, with their places, those with most joints first.

    Raises:
        ValueError: None fits.
    """
    fits = [skeleton for skeleton in skeletons if not set(skeleton.missing(names)) & set(NEEDED)]
    if fits:
        fits.sort(key=lambda skeleton: len(skeleton.missing(names)))
        return [(skeleton, skeleton.find(names)) for skeleton in fits]
    nearest = min(skeletons, key=lambda skeleton: len(set(skeleton.missing(names)) & set(NEEDED)))
    joint = nearest.missing(names)[0]
    raise ValueError(
        f"joints: they fit no known skeleton; the nearest is {nearest.name}, without "
        f"{shown(' or '.join(nearest.joints[joint]))} ({joint}); there are {shown(list(names))}; name them in a file "
        "of your own, data.source.skeleton=FILE.yaml"
    )
