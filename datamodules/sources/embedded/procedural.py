"""Poses without a donor: postures of the families, as rotations."""

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.embedded.arms import draw_targets, pose_arms
from datamodules.sources.embedded.families import FAMILIES
from datamodules.sources.embedded.joint_limits import LEG_AXES
from datamodules.sources.embedded.posture import Draw, Posture
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS
from ljn.geometry.rotations import euler_to_rotmat

_SPINE_SHARES = {"spine1": 0.45, "spine2": 0.35, "spine3": 0.20}
"""Most of a trunk's motion is lumbar."""
_REST_SPREAD_DEG = 4.0
"""How far legs stand apart in the rest pose of bodies in SMPL's format."""


def draw_poses(rng: np.random.Generator, families: np.ndarray, offsets: Tensor) -> Tensor:
    """Poses `(n, 24, 3, 3)` of the families named `(n,)`, on a skeleton (`joint_offsets`), before joint limits."""
    n = len(families)
    angles = np.zeros((n, NUM_JOINTS, 3))
    goals = np.zeros((n, 2), np.int64)
    swing, drop = np.zeros(n), np.zeros(n)
    for name, family in FAMILIES.items():
        rows = np.flatnonzero(families == name)
        if len(rows):
            draw = Draw(rng, len(rows))
            posture = family(draw)
            angles[rows] = _joint_angles(posture, draw)
            goals[rows], swing[rows], drop[rows] = posture.goals, posture.swing, posture.drop
    rotmat = euler_to_rotmat(LEG_AXES, torch.from_numpy(angles).deg2rad())
    pose_arms(rng, draw_targets(rng, goals, swing, drop), offsets, rotmat)
    return rotmat


def _joint_angles(posture: Posture, draw: Draw) -> np.ndarray:
    """Angles `(n, 24, 3)` about x, z and y, degrees, of all but the arms; feet and neck are drawn here."""
    angles = np.zeros((draw.n, NUM_JOINTS, 3))

    def turn(joint: str, *turns: np.ndarray | float) -> None:
        for axis, angle in enumerate(turns):
            angles[:, JOINT_INDEX[joint], axis] = angle

    turn("pelvis", posture.pitch, posture.roll, posture.turn)
    of_legs = (posture.spread, posture.turnout, posture.foot)
    spread, turnout, foot = (np.broadcast_to(angle, (draw.n, 2)) for angle in of_legs)
    for leg, (side, sign) in enumerate(SIDES.items()):
        thigh, knee = posture.thigh[:, leg], posture.knee[:, leg].clip(0, 150)
        aside = sign * (spread[:, leg] - _REST_SPREAD_DEG)
        turn(f"{side}_hip", -(thigh + posture.pitch), aside, sign * turnout[:, leg])
        turn(f"{side}_knee", knee, draw.normal(2), draw.normal(3))
        # The foot is level where the turns of pelvis, hip, knee and ankle about x add up to nothing.
        turn(f"{side}_ankle", thigh - knee - foot[:, leg], draw.normal(5), draw.normal(6))
        turn(f"{side}_foot", draw.normal(6), 0.0, draw.normal(3))
    for joint, share in _SPINE_SHARES.items():
        turn(joint, share * posture.bend + draw.normal(2), share * posture.lean, share * posture.twist)
    # The head makes up for a part of the bend: people look ahead.
    nod = posture.nod - 0.15 * posture.bend + draw.normal(12)
    lean, about = draw.normal(6), draw.normal(18)
    for joint in ("neck", "head"):
        turn(joint, nod / 2, lean / 2, about / 2)
    return angles
