"""How far joints turn: published ranges of motion, and poses held within them.

Hinge joints and short chains (spine, neck, hip) are described by three angles in the order flexion, sideways, twist,
as clinicians and the International Society of Biomechanics do (Grood and Suntay 1983; Wu et al. 2002): legal poses
lie far from the singular sideways angle of 90 degrees. A shoulder has no such angle to spare: it is described by
where the upper arm points and by its twist.

Ranges are those of the American Academy of Orthopaedic Surgeons (1965) and of Norkin and White, *Measurement of
Joint Motion*, widened where athletes in motion capture go beyond, up to the table of dm_control's humanoid_CMU.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX
from ljn.geometry.rotations import euler_to_rotmat, rotmat_to_euler, rotvec_to_rotmat, swing_twist


class Ranges(NamedTuple):
    """Limits of three angles, degrees, for the left side or the middle; the right side mirrors them."""

    axes: str  # the axes in the order of the product, see `euler_to_rotmat`
    low: tuple[float, float, float]
    high: tuple[float, float, float]


# Left side, SMPL's axes. About x: leg forward, foot up, trunk backward are negative. About y: outward (hip, foot) or
# to the left (trunk) is positive. About z: outward (leg), up (arm), to the right (trunk) is positive.
LEG_AXES, ARM_AXES, ELBOW_AXES = "xzy", "zyx", "yzx"
RANGES: dict[str, Ranges] = {
    #                          flexion  sideways  twist
    "hip": Ranges(LEG_AXES, (-135.0, -35.0, -45.0), (35.0, 65.0, 60.0)),
    "knee": Ranges(LEG_AXES, (-5.0, -8.0, -15.0), (150.0, 8.0, 15.0)),
    "ankle": Ranges(LEG_AXES, (-35.0, -35.0, -25.0), (55.0, 20.0, 30.0)),
    "foot": Ranges(LEG_AXES, (-60.0, -5.0, -10.0), (40.0, 5.0, 10.0)),
    # Thoracolumbar motion (flexion 80, extension 30, sideways 35, twist 45), shared by three joints, each of which may
    # take more than its share.
    "spine1": Ranges(LEG_AXES, (-20.0, -20.0, -20.0), (45.0, 20.0, 20.0)),
    "spine2": Ranges(LEG_AXES, (-20.0, -20.0, -20.0), (35.0, 20.0, 20.0)),
    "spine3": Ranges(LEG_AXES, (-20.0, -20.0, -20.0), (30.0, 20.0, 20.0)),
    # Neck (flexion 50, extension 60, sideways 45, twist 80), shared by two; skeletons differ in how.
    "neck": Ranges(LEG_AXES, (-30.0, -25.0, -35.0), (30.0, 25.0, 35.0)),
    "head": Ranges(LEG_AXES, (-50.0, -30.0, -55.0), (35.0, 30.0, 55.0)),
    #                          up      back     roll
    "collar": Ranges(ARM_AXES, (-25.0, -25.0, -15.0), (30.0, 15.0, 15.0)),
    # The forearm's turn (85 each way) is shared by elbow and wrist: motion capture often has it at the wrist.
    "wrist": Ranges(ARM_AXES, (-75.0, -30.0, -40.0), (70.0, 30.0, 40.0)),
    "hand": Ranges(ARM_AXES, (-30.0, -15.0, -15.0), (30.0, 15.0, 15.0)),
    #                            flexion  carrying  forearm's turn
    "elbow": Ranges(ELBOW_AXES, (-150.0, -12.0, -85.0), (5.0, 12.0, 85.0)),
}
SHOULDER_BACK_DEG = 60.0
"""How far an arm points behind the plane of the chest: extension of 60 degrees with the arm down."""
SHOULDER_ACROSS_DEG = 50.0
"""How far it points across the body: horizontal adduction of 135 to 140 degrees, 90 of which lead to the front."""
SHOULDER_TWIST_DEG = (-150.0, 90.0)
"""Inward positive, left side, after the shortest way from the T-pose. The published 90 outward and 70 inward are
counted from another zero, which lies at 0 with the arm down and at -90 with the arm raised to the front."""


def _joints(kind: str) -> list[tuple[int, int]]:
    """Indices of a kind of joint, each with the sign of its side."""
    if kind in JOINT_INDEX:
        return [(JOINT_INDEX[kind], 1)]
    return [(JOINT_INDEX[f"{side}_{kind}"], sign) for side, sign in SIDES.items()]


def _limits_of_side(ranges: Ranges, sign: int) -> tuple[list[float], list[float]]:
    bounds = zip(ranges.axes, ranges.low, ranges.high)
    turned = [(low, high) if axis == "x" or sign > 0 else (-high, -low) for axis, low, high in bounds]
    return [low for low, _ in turned], [high for _, high in turned]


class _Group(NamedTuple):
    """All joints that share an order of axes: `joints` (k), `low` and `high` (k, 3), radians."""

    axes: str
    joints: list[int]
    low: Tensor
    high: Tensor


def _grouped() -> list[_Group]:
    groups = []
    for axes in (LEG_AXES, ARM_AXES, ELBOW_AXES):
        rows = [
            (joint, *_limits_of_side(ranges, sign))
            for kind, ranges in RANGES.items()
            if ranges.axes == axes
            for joint, sign in _joints(kind)
        ]
        joints, *limits = (list(column) for column in zip(*rows))
        low, high = (torch.tensor(limit, dtype=torch.float64).deg2rad() for limit in limits)
        groups.append(_Group(axes, joints, low, high))
    return groups


_GROUPS = _grouped()


def within_limits(rotmat: Tensor) -> Tensor:
    """Poses `(n, 24, 3, 3)` held within the ranges of motion; joints within them stay, to the last bit."""
    result = rotmat.clone()
    for axes, joints, low, high in _GROUPS:
        angles = rotmat_to_euler(axes, rotmat[:, joints])
        clamped = angles.clamp(low, high)
        is_outside = (clamped != angles).any(-1)[..., None, None]
        result[:, joints] = torch.where(is_outside, euler_to_rotmat(axes, clamped), rotmat[:, joints])
    for joint, sign in _joints("shoulder"):
        result[:, joint] = _shoulder_within_limits(rotmat[:, joint], sign)
    return result


def _shoulder_within_limits(rotmat: Tensor, sign: int) -> Tensor:
    """One shoulder's rotations `(n, 3, 3)` with the upper arm's direction and its twist held within limits."""
    arm = torch.tensor([float(sign), 0.0, 0.0], dtype=rotmat.dtype)
    swing, twist = swing_twist(rotmat, arm)
    inward = sign * twist
    low, high = (math.radians(limit) for limit in SHOULDER_TWIST_DEG)
    clamped = inward.clamp(low, high)
    is_outside = clamped != inward

    towards = swing @ arm
    for forbidden, limit_deg in (
        (torch.tensor([0.0, 0.0, -1.0], dtype=rotmat.dtype), SHOULDER_BACK_DEG),
        (-arm, SHOULDER_ACROSS_DEG),
    ):
        towards, is_beyond = _outside_cap(towards, forbidden, limit_deg)
        is_outside = is_outside | is_beyond
    axis = torch.linalg.cross(arm.expand_as(towards), towards)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (towards @ arm)[:, None])
    shortest = rotvec_to_rotmat(angle * axis / sine.clamp(min=1e-12))
    held = shortest @ rotvec_to_rotmat((sign * clamped)[:, None] * arm)
    return torch.where(is_outside[:, None, None], held, rotmat)


def _outside_cap(direction: Tensor, pole: Tensor, limit_deg: float) -> tuple[Tensor, Tensor]:
    """Unit vectors `(n, 3)` pushed out of the cap around `pole` (more than `limit_deg` past its equator)."""
    limit = torch.tensor(limit_deg, dtype=direction.dtype).deg2rad()
    height = direction @ pole
    is_beyond = height > limit.sin()
    level = direction - height[:, None] * pole
    level = level / level.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    return torch.where(is_beyond[:, None], limit.cos() * level + limit.sin() * pole, direction), is_beyond


def with_square_elbows(rotmat: Tensor) -> Tensor:
    """Poses `(n, 24, 3, 3)` whose elbows bend about their hinge, every joint where it was.

    Motion capture leaves open how far an upper arm is turned about itself, and files differ in where they put an
    elbow's axis. The sideways part of a bent elbow is handed on to the shoulder as twist: forearm and hand keep their
    places and directions. Below 5 degrees of flexion an elbow's plane says nothing; above 20 all is handed on.
    """
    result = rotmat.clone()
    for side, sign in SIDES.items():
        shoulder, elbow = JOINT_INDEX[f"{side}_shoulder"], JOINT_INDEX[f"{side}_elbow"]
        forearm = sign * rotmat[:, elbow, :, 0]  # where it points, in the upper arm's frame
        across = torch.hypot(forearm[:, 1], forearm[:, 2])
        flexion = torch.atan2(across, sign * forearm[:, 0]).rad2deg()
        share = ((flexion - 5) / 15).clamp(0, 1)
        angle = torch.atan2(forearm[:, 1], forearm[:, 2]) * share
        twist = rotvec_to_rotmat(angle[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=rotmat.dtype))
        result[:, shoulder] = rotmat[:, shoulder] @ twist.mT
        result[:, elbow] = twist @ rotmat[:, elbow]
    return result
