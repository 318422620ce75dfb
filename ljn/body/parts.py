"""Named parts of the body's surface, found from the skinning weights of any SMPL-format file."""

import numpy as np
from numpy.typing import NDArray

from ljn.body.files import BodyModel
from ljn.body.skeleton import JOINT_NAMES

_TRUNK = {
    "pelvis": "hips", "spine1": "abdomen", "spine2": "abdomen", "spine3": "chest", "collar": "chest", "neck": "neck",
    "head": "head",
}  # fmt: skip
_LIMBS = {
    "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hand": "hand", "hip": "thigh", "knee": "calf",
    "ankle": "foot", "foot": "foot",
}  # fmt: skip

PART_NAMES: tuple[str, ...] = (
    *dict.fromkeys(reversed(_TRUNK.values())),
    *(side + part for part in dict.fromkeys(_LIMBS.values()) for side in ("l_", "r_")),
)
"""The trunk's parts from the head down, then the limbs', left before right."""


def _part_of_joint(name: str) -> int:
    side, _, joint = name.rpartition("_")
    return PART_NAMES.index(_TRUNK[joint] if joint in _TRUNK else f"{side}_{_LIMBS[joint]}")


PART_OF_JOINT: tuple[int, ...] = tuple(_part_of_joint(name) for name in JOINT_NAMES)
"""For each joint the index in `PART_NAMES` of the part that it moves."""


def face_parts(model: BodyModel) -> NDArray[np.int64]:
    """The part that each face belongs to: the one whose joints move its three vertices most.

    A patch that is cut off from the largest one of its part goes to the part that borders on it most, so that
    every part is connected on a connected mesh.

    Args:
        model: Any body in SMPL's format.

    Returns:
        `(F,)`, indices into `PART_NAMES`. On a symmetric body, mirrored faces have mirrored parts.
    """
    shares = np.zeros((len(PART_NAMES), len(model.weights)))
    for joint, part in enumerate(PART_OF_JOINT):
        shares[part] += model.weights[:, joint]
    # Float64 sums of three float32 are exact, in any order; ties go to the trunk, whose parts come first.
    labels = shares[:, model.faces].sum(2).argmax(0)
    neighbours = _face_neighbours(model.faces)
    # A patch may join another stray one; each round makes at least one patch fewer.
    for _ in range(len(labels)):
        strays = _stray_patches(labels, neighbours)
        if not strays:
            break
        moved = labels.copy()
        for patch in strays:
            around = labels[np.unique(neighbours[patch])]
            around = around[around != labels[patch[0]]]
            if len(around):
                moved[patch] = np.bincount(around).argmax()
        if np.array_equal(moved, labels):
            break
        labels = moved
    return labels.astype(np.int64)


def _face_neighbours(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """`(F, 3)`: the face across each edge; at an open border the face itself."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    owners = np.repeat(np.arange(len(faces)), 3)
    keys = np.sort(edges, axis=1)
    order = np.lexsort((keys[:, 1], keys[:, 0]))
    is_pair = (keys[order[1:]] == keys[order[:-1]]).all(1)
    first, second = order[:-1][is_pair], order[1:][is_pair]
    across = owners.copy()
    across[first], across[second] = owners[second], owners[first]
    return across.reshape(-1, 3)


def _stray_patches(labels: NDArray[np.int64], neighbours: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The connected patches of equal labels that are not the largest of their label."""
    patch = np.full(len(labels), -1)
    patches: list[list[int]] = []
    for seed in range(len(labels)):
        if patch[seed] >= 0:
            continue
        patch[seed] = len(patches)
        members = [seed]
        for face in members:
            for other in neighbours[face]:
                if patch[other] < 0 and labels[other] == labels[seed]:
                    patch[other] = len(patches)
                    members.append(int(other))
        patches.append(members)
    largest: dict[int, int] = {}
    for number, members in enumerate(patches):
        label = int(labels[members[0]])
        if label not in largest or len(members) > len(patches[largest[label]]):
            largest[label] = number
    return [
        np.array(members)
        for number, members in enumerate(patches)
        if largest[int(labels[members[0]])] != number
    ]
