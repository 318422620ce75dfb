"""Named extreme poses: what the bodies are looked at and measured in."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS
from ljn.geometry.rotations import euler_to_rotmat, rotmat_to_rotvec

Angles = Mapping[str, tuple[float, float, float]]

ARMS_DOWN: Angles = {"collar": (0, 0, -8), "shoulder": (0, 0, -62)}

EXTREME_POSES: dict[str, Angles] = {
    "arms down": ARMS_DOWN,
    "arms up": {"collar": (0, 0, 22), "shoulder": (0, 0, 62)},
    "arms up, shoulders alone": {"shoulder": (0, 0, 85)},
    "arms forward": {"collar": (0, -15, 0), "shoulder": (0, -75, 0)},
    "arms across the chest": {"collar": (0, -15, 0), "shoulder": (0, -95, -15), "elbow": (0, -60, 0)},
    "elbows bent": {"shoulder": (0, 0, -30), "elbow": (0, -140, 0)},
    "squat": {"pelvis": (25, 0, 0), "hip": (-115, 0, 18), "knee": (130, 0, 0), "ankle": (-25, 0, 0), **ARMS_DOWN},
    "sitting": {"hip": (-90, 0, 5), "knee": (90, 0, 0), **ARMS_DOWN},
    "knees bent": {"knee": (140, 0, 0), **ARMS_DOWN},
    "high kick": {"l_hip": (-100, 0, 0), "r_hip": (20, 0, 0), **ARMS_DOWN},
    "legs apart": {"hip": (0, 0, 45), **ARMS_DOWN},
    "twist": {"spine1": (0, 18, 0), "spine2": (0, 18, 0), "spine3": (0, 18, 0), "neck": (0, 30, 0), **ARMS_DOWN},
    "bend": {
        "pelvis": (20, 0, 0), "hip": (-60, 0, 0), "spine1": (20, 0, 0), "spine2": (20, 0, 0),
        "spine3": (20, 0, 0), **ARMS_DOWN,
    },
    "bend sideways": {
        "spine1": (0, 0, 15), "spine2": (0, 0, 15), "spine3": (0, 0, 15), "neck": (0, 0, 20), **ARMS_DOWN,
    },
}  # fmt: skip
"""Euler angles in degrees (x first, then y, then z, about the rest frame's axes; x to the body's left, y up,
z forward). A limb's name without its side stands for the left joint and, mirrored, for the right one."""


def pose_vector(angles: Angles) -> NDArray[np.float64]:
    """The pose `(72,)`, radians, of Euler angles written as in `EXTREME_POSES`."""
    rotmats = torch.eye(3, dtype=torch.float64).repeat(NUM_JOINTS, 1, 1)
    for name, (x, y, z) in angles.items():
        turns = (
            {name: (z, y, x)} if name in JOINT_INDEX else {f"l_{name}": (z, y, x), f"r_{name}": (-z, -y, x)}
        )
        for joint, turn in turns.items():
            rotmats[JOINT_INDEX[joint]] = euler_to_rotmat(
                "zyx", torch.tensor(turn, dtype=torch.float64).deg2rad()
            )
    return rotmat_to_rotvec(rotmats).flatten().numpy()
