"""Which joint of a BVH skeleton each of SMPL's joints follows: small YAML files, some of which ship."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ljn.body.skeleton import JOINT_INDEX
from ljn.reading import READ_ERRORS, read_yaml, reason, shown

_DIRECTORY = Path(__file__).parent / "skeletons"
SHIPPED = ("smpl", "cmu_daz", "cmu_motionbuilder", "mixamo", "truebones")
"""The skeletons that ship, in the order in which they are tried."""
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
    """

    name: str
    joints: Mapping[str, tuple[str, ...]]
    skip_frames: int = 0
    rest_frame: int | None = None
    same_rest: bool = False

    def missing(self, names: Iterable[str]) -> list[str]:
        """The joints that a file with these names does not have."""
        places = _places(names)
        return [joint for joint, choices in self.joints.items() if not places.keys() & _lower(choices)]

    def find(self, names: Iterable[str]) -> dict[str, int]:
        """The place among a file's `names` of the joint that each of SMPL's joints follows, none of them missing.

        Names count without what a program puts before a colon (`mixamorig:Hips`) and without regard to case.

        Raises:
            ValueError: A name is there twice.
        """
        places = _places(names)
        found = {}
        for joint, choices in self.joints.items():
            name = next(name for name in _lower(choices) if name in places)
            if len(places[name]) > 1:
                raise ValueError(f"joint {shown(name)} ({joint}) is there {len(places[name])} times")
            [found[joint]] = places[name]
        return found


def _places(names: Iterable[str]) -> dict[str, list[int]]:
    """Where each name stands, in lower case and without what is before a colon."""
    places: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        places.setdefault(name.rpartition(":")[2].lower(), []).append(place)
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
    skip, rest, same = table.get("skip_frames", 0), table.get("rest_frame"), table.get("same_rest", False)
    if type(skip) is not int or skip < 0 or not (rest is None or (type(rest) is int and rest >= 0)):
        raise ValueError(
            f"{where}: skip_frames, rest_frame: expected 0 or more, got {shown(skip)} and {shown(rest)}"
        )
    if not isinstance(same, bool):
        raise ValueError(f"{where}: same_rest: expected true or false, got {shown(same)}")
    return Skeleton(path.stem, joints, skip, rest, same)


def known_skeletons(choice: str | Path) -> list[Skeleton]:
    """The skeletons that a setting means: those that ship for `auto`, one of them by name, or a file's."""
    if choice == AUTO:
        return [read_skeleton(_DIRECTORY / f"{name}.yaml") for name in SHIPPED]
    return [read_skeleton(_DIRECTORY / f"{choice}.yaml" if choice in SHIPPED else Path(choice))]


def fitting(skeletons: list[Skeleton], names: tuple[str, ...]) -> tuple[Skeleton, dict[str, int]]:
    """The first skeleton all of whose joints a file has, and their places; see `Skeleton.find`.

    Raises:
        ValueError: None fits.
    """
    for skeleton in skeletons:
        if not skeleton.missing(names):
            return skeleton, skeleton.find(names)
    nearest = min(skeletons, key=lambda skeleton: len(skeleton.missing(names)))
    joint = nearest.missing(names)[0]
    raise ValueError(
        f"joints: they fit no known skeleton; the nearest is {nearest.name}, without "
        f"{shown(' or '.join(nearest.joints[joint]))} ({joint}); there are {shown(list(names))}; name them in a file "
        "of your own, data.source.skeleton=FILE.yaml"
    )
