import math

import torch

from ljn.body import SMPL
from ljn.body.kinematics import (
    joint_positions,
    mirror,
    without_heading,
    world_rotations,
)
from ljn.body.skeleton import MIRROR
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat

DTYPE = torch.float64


def random_rotmat(*shape, scale=0.5, seed=0):
    return rotvec_to_rotmat(
        scale * torch.randn(*shape, 3, dtype=DTYPE, generator=torch.Generator().manual_seed(seed))
    )


def test_joints_are_those_of_the_body_layer(body, offsets):
    rotmat = random_rotmat(6, 24)
    pose = rotmat_to_rotvec(rotmat).flatten(1)
    expected = SMPL(body).double()(pose, torch.zeros(6, 10, dtype=DTYPE)).joints
    joints = joint_positions(world_rotations(rotmat), offsets)
    torch.testing.assert_close(joints, expected - expected[:, :1], atol=1e-6, rtol=0)


def test_the_mirror_image_of_a_pose_mirrors_the_skeleton(offsets):
    rotmat = random_rotmat(10, 24)
    joints, mirrored = (
        joint_positions(world_rotations(poses), offsets) for poses in (rotmat, mirror(rotmat))
    )
    across = torch.tensor([-1.0, 1.0, 1.0], dtype=DTYPE)
    # The body file is symmetric to a fraction of a millimetre.
    torch.testing.assert_close(mirrored, joints[:, list(MIRROR)] * across, atol=1e-3, rtol=0)
    assert (mirrored - joints).abs().max() > 0.1
    torch.testing.assert_close(mirror(mirror(rotmat)), rotmat)


def test_dropping_the_heading_forgets_a_turn_about_the_vertical_and_nothing_else():
    root = random_rotmat(100, scale=0.8)
    turn = rotation_about("y", torch.linspace(-3, 3, 100, dtype=DTYPE))
    torch.testing.assert_close(without_heading(turn @ root), without_heading(root))
    torch.testing.assert_close(
        without_heading(root)[:, 1], root[:, 1]
    )  # how each axis stands to the vertical
    upright = without_heading(turn)
    torch.testing.assert_close(upright, torch.eye(3, dtype=DTYPE).expand_as(upright))


def test_bodies_that_lean_lie_or_stand_on_their_side_keep_their_attitude():
    angle = torch.linspace(-3.1, 3.1, 50, dtype=DTYPE)
    for axis in "xz":  # forward and backward, to the sides; all but upside down
        attitude = rotation_about(axis, angle)
        torch.testing.assert_close(without_heading(attitude), attitude, atol=1e-7, rtol=0)


def test_a_backward_lean_past_the_vertical_makes_no_jump():
    # The pelvis looks straight up at 90 degrees; where it looks is of no use as a heading there.
    lean = rotation_about("x", torch.tensor([-89.9, -90.1], dtype=DTYPE).deg2rad())
    turned = rotation_about("y", torch.tensor(0.3, dtype=DTYPE)) @ lean
    one, other = without_heading(turned)
    assert math.degrees(rotmat_to_rotvec(one.mT @ other).norm()) < 0.3
