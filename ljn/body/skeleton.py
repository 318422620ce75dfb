"""The 24 SMPL joints: names, tree, mirror pairs and named groups. The only place with joint indices."""

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle", "spine3",
    "l_foot", "r_foot", "neck", "l_collar", "r_collar", "head", "l_shoulder", "r_shoulder", "l_elbow",
    "r_elbow", "l_wrist", "r_wrist", "l_hand", "r_hand",
)  # fmt: skip
NUM_JOINTS = len(JOINT_NAMES)
JOINT_INDEX: dict[str, int] = {name: index for index, name in enumerate(JOINT_NAMES)}

PARENTS: tuple[int, ...] = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21,
)  # fmt: skip
"""Parent of each joint; -1 for the root. A parent's index is always lower than its child's."""

ROOT = JOINT_INDEX["pelvis"]
HEAD_BONE: tuple[int, int] = (JOINT_INDEX["neck"], JOINT_INDEX["head"])
"""The bone whose half length is PCKh's threshold (joints 13 and 16 counted from 1, section 3.7.1)."""


def _mirrored(name: str) -> str:
    swapped = {"l_": "r_", "r_": "l_"}
    return swapped.get(name[:2], name[:2]) + name[2:]


MIRROR: tuple[int, ...] = tuple(JOINT_INDEX[_mirrored(name)] for name in JOINT_NAMES)
"""Index of each joint's left-right counterpart (a trunk joint is its own)."""


def _levels() -> tuple[tuple[int, ...], ...]:
    depth = [0] * NUM_JOINTS
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            depth[joint] = depth[parent] + 1
    return tuple(tuple(j for j in range(NUM_JOINTS) if depth[j] == d) for d in range(max(depth) + 1))


LEVELS: tuple[tuple[int, ...], ...] = _levels()
"""Joints by their distance from the root: all of a level can be moved at once."""

BONES: tuple[tuple[int, int], ...] = tuple(
    (parent, joint) for joint, parent in enumerate(PARENTS) if parent >= 0
)
