"""A body's surface as clothes and skin see it: in the rest pose, with the landmarks that garments end at."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ljn.body import BodyModel
from ljn.body.parts import PART_NAMES, face_parts
from ljn.body.skeleton import JOINT_INDEX

HEAD, TRUNK, ARM, LEG = range(4)
_REGIONS = {
    "head": HEAD, "neck": HEAD, "chest": TRUNK, "abdomen": TRUNK, "hips": TRUNK, "upper_arm": ARM, "forearm": ARM,
    "hand": ARM, "thigh": LEG, "calf": LEG, "foot": LEG,
}  # fmt: skip


class Surface(NamedTuple):
    """A body in SMPL's rest pose: x to its left, y up, z to the front, arms along x; metres.

    Attributes:
        faces: `(F, 3)` int64.
        regions: `(F,)` int8: head (with the neck), trunk, arm or leg.
        rest: `(V, 3)` float32, the vertices.
        head: `(4,)` float32: y of the head's chin and top, z of its back and front.
        trunk: `(2,)` float32: y of the pelvis and the neck.
        arm: `(4,)` float32: |x| of shoulder, elbow, wrist and fingertips.
        leg: `(4,)` float32: -y of hip, knee, ankle and sole.
    """

    faces: np.ndarray
    regions: np.ndarray
    rest: np.ndarray
    head: np.ndarray
    trunk: np.ndarray
    arm: np.ndarray
    leg: np.ndarray


@lru_cache(maxsize=8)
def surface_of(body: BodyModel) -> Surface:
    """The surface of a body in SMPL's format."""
    rest = np.asarray(body.v_template, np.float64)
    joints = np.asarray(body.J_regressor @ rest)
    joint = {name: joints[index] for name, index in JOINT_INDEX.items()}
    skull = rest[np.asarray(body.weights)[:, JOINT_INDEX["head"]] > 0.5]
    (_, low, back), (_, high, front) = skull.min(0), skull.max(0)
    region_of_part = np.array(
        [_REGIONS[name.removeprefix("l_").removeprefix("r_")] for name in PART_NAMES], np.int8
    )
    arm = [abs(joint[f"l_{name}"][0]) for name in ("shoulder", "elbow", "wrist")]
    leg = [-joint[f"l_{name}"][1] for name in ("hip", "knee", "ankle")]

    def numbers(*values: float) -> np.ndarray:
        return np.array(values, np.float32)

    return Surface(
        np.array(body.faces, np.int64),
        region_of_part[face_parts(body)],
        rest.astype(np.float32),
        numbers(low, high, back, front),
        numbers(joint["pelvis"][1], joint["neck"][1]),
        numbers(*arm, np.abs(rest[:, 0]).max()),
        numbers(*leg, -rest[:, 1].min()),
    )
