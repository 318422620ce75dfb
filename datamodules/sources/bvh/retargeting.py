"""From a BVH skeleton's rotations to those of SMPL's joints.

A joint's rotation is R_smpl = M R M^T O: R leads from the file's rest pose into its world, M from the file's axes into
SMPL's (x to the body's left, y up, z forward), and O from SMPL's rest bone to the file's. M is read off the rest pose.
"""

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.bvh.file import BvhFile, joint_transforms
from datamodules.sources.bvh.skeleton import Skeleton, axes_of
from datamodules.sources.reference import REFERENCE_OFFSETS
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX, NUM_JOINTS, PARENTS
from ljn.geometry.rotations import interpolate_rotmat, rotation_about, rotvec_to_rotmat

_LIMBS = {
    f"{side}_{joint}": f"{side}_{child}"
    for side in SIDES
    for joint, child in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
}
"""The bones that are laid on SMPL's, by the joints at their two ends."""
_SPINE = ("pelvis", "spine1", "spine2", "spine3")
_TINY = 1e-6
_SAME_REST_DEG = 30.0  # an arm that rests farther from SMPL's takes the hand with it


def retarget(bvh: BvhFile, skeleton: Skeleton, places: dict[str, int], rows: np.ndarray) -> Tensor:
    """SMPL's rotations of some frames, relative to the parent joint, in SMPL's axes.

    Args:
        bvh: The file.
        skeleton: Its kind.
        places: For SMPL's joints, the file's joint that each follows.
        rows: `(T,)`, the frames.

    Returns:
        `(T, 24, 3, 3)` float64.

    Raises:
        ValueError: Its rest pose is no person's who stands upright.
    """
    rotations, _ = joint_transforms(bvh, rows)
    rest, positions = _rest(bvh, skeleton, places)
    joints = {name: positions[place] for name, place in places.items()}
    axes = _smpl_axes(joints)
    if skeleton.rest_axes and not torch.equal(axes, torch.eye(3, dtype=torch.float64)):
        raise ValueError(f"OFFSET: {_NO_REST}, by the axes of {skeleton.name}")
    facing = torch.eye(3, dtype=torch.float64)
    if skeleton.rest_frame is not None:  # a frame may face anywhere
        left = axes @ (joints["l_hip"] - joints["r_hip"])
        facing = rotation_about("y", torch.atan2(-left[2], left[0]))
    world = {
        name: axes @ rotations[:, place] @ rest[place].T @ axes.T @ facing for name, place in places.items()
    }
    if not skeleton.same_rest:
        upright = {name: facing.T @ axes @ position for name, position in joints.items()}
        for name, turn in _rest_turns(upright, bool(skeleton.rest_axes)).items():
            if name in world:
                world[name] = world[name] @ turn
    return _local(_completed(world))


def _rest(bvh: BvhFile, skeleton: Skeleton, places: dict[str, int]) -> tuple[Tensor, Tensor]:
    """Rotations `(J, 3, 3)` and positions `(J, 3)` of the pose that the file rests in, its own axes."""
    if skeleton.rest_axes:
        return _rest_of_axes(
            bvh, {places[name]: text for name, text in skeleton.rest_axes.items() if name in places}
        )
    if skeleton.rest_frame is None:
        still = bvh._replace(channels=((),) * len(bvh.names))
        rotations, positions = joint_transforms(still, np.array([0]))
    elif skeleton.rest_frame < len(bvh.frames):
        rotations, positions = joint_transforms(bvh, np.array([skeleton.rest_frame]))
    else:
        raise ValueError(f"rest_frame: frame {skeleton.rest_frame} of {len(bvh.frames)}")
    return rotations[0], positions[0]


def _rest_of_axes(bvh: BvhFile, axes: dict[int, str]) -> tuple[Tensor, Tensor]:
    """The T-pose in which the axes of the file's joints lead left, up and forward as a table says."""
    rotations: list[Tensor] = []
    positions: list[Tensor] = []
    for joint, parent in enumerate(bvh.parents):
        rows = axes_of(axes[joint]) if joint in axes else None
        above = torch.eye(3, dtype=torch.float64) if parent < 0 else rotations[parent]
        rotations.append(above if rows is None else torch.from_numpy(rows))
        offset = torch.from_numpy(bvh.offsets[joint])
        positions.append(offset if parent < 0 else positions[parent] + above @ offset)
    return torch.stack(rotations), torch.stack(positions)


def _smpl_axes(joints: dict[str, Tensor]) -> Tensor:
    """M: of a rest pose's joint positions in the file's axes, the rotation `(3, 3)` into SMPL's.

    Raises:
        ValueError: They are no standing person's.
    """
    hips = (joints["l_hip"] + joints["r_hip"]) / 2
    shoulders = (joints["l_shoulder"] + joints["r_shoulder"]) / 2
    up = _axis(shoulders - hips, "spine")
    left = _axis(joints["l_hip"] - joints["r_hip"], "hips")
    if up @ left != 0:
        raise ValueError(f"OFFSET: {_NO_REST}, the line from hip to hip runs along the spine")
    axes = torch.stack([left, up, torch.linalg.cross(left, up)])
    for side in SIDES:
        for name in (f"{side}_hip", f"{side}_knee"):
            bone = axes @ (joints[_LIMBS[name]] - joints[name])
            if bone.norm() < _TINY or bone[1] > -0.5 * bone.norm():
                raise ValueError(f"OFFSET: {_NO_REST}, {_LIMBS[name]} is not below {name}")
        for name in (f"{side}_shoulder", f"{side}_elbow"):
            bone = axes @ (joints[_LIMBS[name]] - joints[name])
            if (
                bone.norm() < _TINY
                or SIDES[side] * bone[0] < -0.5 * bone.norm()
                or bone[1] > 0.7 * bone.norm()
            ):
                raise ValueError(f"OFFSET: {_NO_REST}, {_LIMBS[name]} is neither beside nor below {name}")
    return axes


_NO_REST = (
    "its rest pose shows no one standing upright with arms out or down (in a file of "
    "data.source.skeleton, rest_frame: 0 takes a frame that does, and rest_axes says where bones along one axis lead)"
)


def _axis(direction: Tensor, name: str) -> Tensor:
    """The coordinate axis, with its sign, that a direction `(3,)` runs along."""
    if direction.norm() < _TINY:
        raise ValueError(f"OFFSET: {_NO_REST}, its {name} has no length")
    largest = int(direction.abs().argmax())
    axis = torch.zeros(3, dtype=torch.float64)
    axis[largest] = torch.sign(direction[largest])
    return axis


def _rest_turns(joints: dict[str, Tensor], with_feet: bool) -> dict[str, Tensor]:
    """O: for each joint whose bone rests elsewhere than SMPL's, the rotation `(3, 3)` from SMPL's to it.

    Soles rest flat, however high the joints of a foot lie, unless its bone is all that is known of it (`with_feet`).
    """
    turns = {}
    feet = {f"{side}_ankle": f"{side}_foot" for side in SIDES if with_feet and f"{side}_foot" in joints}
    for joint, child in (_LIMBS | feet).items():
        smpl = REFERENCE_OFFSETS[JOINT_INDEX[child]]
        turns[joint] = _between(smpl, joints[child] - joints[joint])
    for side in SIDES:
        arm = turns[f"{side}_elbow"]
        if (arm.trace() - 1) / 2 < math.cos(math.radians(_SAME_REST_DEG)):
            turns |= {f"{side}_wrist": arm, f"{side}_hand": arm}
    return turns


def _between(start: Tensor, end: Tensor) -> Tensor:
    """The shortest rotation `(3, 3)` that leads one direction `(3,)` to another."""
    one, other = start / start.norm(), end / end.norm()
    cross = torch.linalg.cross(one, other)
    angle = torch.atan2(cross.norm(), one @ other)
    return rotvec_to_rotmat(cross / cross.norm().clamp(min=1e-12) * angle)


def _completed(world: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rotations into the world of all 24 joints: those that the file does not have follow from the others."""
    world = dict(world)
    known = [name for name in _SPINE if name in world]
    for below, above in pairwise(known):
        between = _SPINE[_SPINE.index(below) + 1 : _SPINE.index(above)]
        for number, name in enumerate(between, 1):
            share = torch.tensor(number / (len(between) + 1), dtype=torch.float64)
            world[name] = interpolate_rotmat(world[below], world[above], share)
    if "neck" not in world:
        half = torch.tensor(0.5, dtype=torch.float64)
        world["neck"] = interpolate_rotmat(world["spine3"], world.get("head", world["spine3"]), half)
    world.setdefault("head", world["neck"])
    for side, sign in SIDES.items():
        world.setdefault(f"{side}_foot", world[f"{side}_ankle"])
        world.setdefault(f"{side}_hand", world[f"{side}_wrist"])
        if f"{side}_collar" not in world:
            world[f"{side}_collar"] = world["spine3"] @ _collar(
                world["spine3"].mT @ world[f"{side}_shoulder"], side, sign
            )
    return world


def _collar(arm: Tensor, side: str, sign: int) -> Tensor:
    """A collar's rotation `(T, 3, 3)` relative to the spine, of the upper arm's: it takes part of a raised arm.

    Some -17 degrees where the arm hangs, as in SMPL's fits of CMU's subjects, +9 where it is overhead, and forward
    with an arm that reaches forward.
    """
    rest = REFERENCE_OFFSETS[JOINT_INDEX[f"{side}_elbow"]]
    direction = arm @ (rest / rest.norm())
    elevation = direction[:, 1].clamp(-1, 1).asin()
    lift = -0.30 + 0.45 * ((elevation + 0.9) / 2.2).clamp(0, 1)
    reach = -0.10 - 0.25 * direction[:, 2].clamp(-0.2, 0.9)
    return rotvec_to_rotmat(torch.stack([torch.full_like(lift, 0.05), sign * reach, sign * lift], -1))


def _local(world: dict[str, Tensor]) -> Tensor:
    """Rotations relative to the parent joint, `(T, 24, 3, 3)`, of those into the world."""
    stacked = torch.stack([world[name] for name in JOINT_INDEX], 1)
    parents = [max(parent, 0) for parent in PARENTS]
    local = stacked[:, parents].mT @ stacked
    local[:, 0] = stacked[:, 0]
    assert local.shape[1] == NUM_JOINTS
    return local
