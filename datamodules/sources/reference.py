"""A reference skeleton of SMPL's proportions in round numbers: generated poses are kept clear on it and measured on it.

The embedded bodies' hips lie 22 cm apart, the official SMPL body's 13 cm: legs that pass each other on the one may
cross on the other, so poses are tested on both. Nothing here follows the body files, so distances measured on this
skeleton stay comparable when these change.
"""

import torch

from datamodules.sources.penetration import Capsules, tested_pairs
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES

_TRUNK_OFFSETS_M = {
    "spine1": (0.0, 0.115, -0.020),
    "spine2": (0.0, 0.135, 0.005),
    "spine3": (0.0, 0.055, 0.025),
    "neck": (0.0, 0.215, -0.040),
    "head": (0.0, 0.085, 0.050),
}
_LEFT_OFFSETS_M = {
    "hip": (0.065, -0.085, 0.0),
    "knee": (0.035, -0.375, -0.005),
    "ankle": (-0.015, -0.400, -0.040),
    "foot": (0.035, -0.055, 0.120),
    "collar": (0.075, 0.120, -0.020),
    "shoulder": (0.090, 0.035, -0.010),
    "elbow": (0.255, -0.015, -0.025),
    "wrist": (0.250, 0.010, -0.005),
    "hand": (0.085, -0.010, -0.015),
}
# Capsules from joint to joint, as an animator would set them; radii in metres.
_CAPSULES = [("pelvis", "spine2", 0.12), ("spine2", "neck", 0.13), ("neck", "head", 0.07)]
for _s in SIDES:
    _CAPSULES += [
        (f"{_s}_hip", f"{_s}_knee", 0.07),
        (f"{_s}_knee", f"{_s}_ankle", 0.05),
        (f"{_s}_shoulder", f"{_s}_elbow", 0.045),
        (f"{_s}_elbow", f"{_s}_wrist", 0.035),
    ]
# By where they begin: the trunk's own parts, neighbours along a limb, limbs where they leave the trunk, and the thighs.
_MAY_TOUCH = {("pelvis", "spine2"), ("pelvis", "neck"), ("spine2", "neck"), ("l_hip", "r_hip")}
for _s in SIDES:
    _MAY_TOUCH |= {(f"{_s}_hip", f"{_s}_knee"), (f"{_s}_shoulder", f"{_s}_elbow")}
    _MAY_TOUCH |= {("pelvis", f"{_s}_hip"), ("spine2", f"{_s}_shoulder")}


def _offsets() -> torch.Tensor:
    rows = {"pelvis": (0.0, 0.0, 0.0), **_TRUNK_OFFSETS_M}
    for side, sign in SIDES.items():
        rows |= {f"{side}_{name}": (sign * x, y, z) for name, (x, y, z) in _LEFT_OFFSETS_M.items()}
    return torch.tensor([rows[name] for name in JOINT_NAMES], dtype=torch.float64)


REFERENCE_OFFSETS = _offsets()
"""`(24, 3)`, metres: each joint's rest position relative to its parent, SMPL's rest frame."""


def _capsules() -> Capsules:
    begins_at = tuple(begin for begin, _, _ in _CAPSULES)
    return Capsules(
        names=begins_at,
        joints=torch.tensor([[JOINT_INDEX[begin], JOINT_INDEX[end]] for begin, end, _ in _CAPSULES]),
        ends=torch.zeros(len(_CAPSULES), 2, 3, dtype=torch.float64),
        radii=torch.tensor([radius for _, _, radius in _CAPSULES], dtype=torch.float64),
        pairs=tested_pairs(begins_at, _MAY_TOUCH),
    )


REFERENCE_CAPSULES = _capsules()
"""Its body parts; named after the joints that they begin at."""
