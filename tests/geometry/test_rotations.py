import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ljn.geometry.rotations import (
    BODY_TO_OPENGL,
    CAMERA_FROM_BODY,
    body_to_camera,
    euler_to_rotmat,
    interpolate_rotmat,
    rot6d_to_rotmat,
    rotation_about,
    rotmat_to_euler,
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    smpl_pose_to_body_world,
    swing_twist,
)

DTYPE = torch.float64
AXES = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [-0.48, 0.6, 0.64]]
ANGLES = [0.0, 1e-12, 1e-7, 3e-3, 3.2e-3, 0.1, 1.0, 2.0, math.pi - 1e-7, math.pi]


def random_rotvecs(*shape, scale=1.5, dtype=DTYPE):
    return scale * torch.randn(*shape, 3, dtype=dtype, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("angle", [*ANGLES, 4.0, 10.0])
@pytest.mark.parametrize("axis", AXES)
def test_rotmat_equals_scipy(axis, angle):
    rotvec = angle * torch.tensor(axis, dtype=DTYPE)
    expected = Rotation.from_rotvec(rotvec.numpy()).as_matrix()
    np.testing.assert_allclose(rotvec_to_rotmat(rotvec), expected, atol=2e-15)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", AXES)
def test_rotvec_equals_scipy_up_to_the_sign_of_a_half_turn(axis, angle):
    rotvec = angle * torch.tensor(axis, dtype=DTYPE)
    result = rotmat_to_rotvec(torch.tensor(Rotation.from_rotvec(rotvec.numpy()).as_matrix()))
    if angle == math.pi and torch.dot(result, rotvec) < 0:
        result = -result
    np.testing.assert_allclose(result, rotvec, atol=1e-14)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-6), (torch.float64, 1e-14)])
def test_round_trip_of_many_rotations_keeps_the_matrix_and_batch_shape(dtype, tolerance):
    rotmat = rotvec_to_rotmat(random_rotvecs(50, 40, dtype=dtype))
    rotvec = rotmat_to_rotvec(rotmat)
    assert rotvec.shape == (50, 40, 3)
    assert rotvec.norm(dim=-1).max() <= math.pi + tolerance
    torch.testing.assert_close(rotvec_to_rotmat(rotvec), rotmat, atol=tolerance, rtol=0)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradient_of_rotmat_is_right_at_zero_and_near_half_turns(angle):
    rotvec = (angle * torch.tensor(AXES, dtype=DTYPE)).requires_grad_()
    assert torch.autograd.gradcheck(rotvec_to_rotmat, rotvec)


@pytest.mark.parametrize("angle", [*ANGLES[:-2], 3.1])
def test_gradient_of_rotvec_is_right_at_the_identity_and_near_half_turns(angle):
    rotmat = rotvec_to_rotmat(angle * torch.tensor(AXES, dtype=DTYPE)).requires_grad_()
    assert torch.autograd.gradcheck(rotmat_to_rotvec, rotmat)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_exact_identity_and_half_turns(dtype):
    half_turns = torch.diag_embed(2 * torch.eye(3, dtype=dtype) - 1)
    rotmat = torch.cat([torch.eye(3, dtype=dtype)[None], half_turns]).requires_grad_()
    rotvec = rotmat_to_rotvec(rotmat)
    torch.testing.assert_close(rotvec.abs(), math.pi * torch.eye(4, 3, dtype=dtype).roll(1, 0))
    rotvec_to_rotmat(rotvec).square().sum().backward()
    assert rotmat.grad.isfinite().all()


@pytest.mark.parametrize("axis", "xyz")
def test_rotation_about_an_axis_equals_scipy(axis):
    angle = torch.tensor([[0.0, 0.3], [-2.0, math.pi]], dtype=DTYPE)
    expected = Rotation.from_euler(axis, angle.reshape(-1, 1).numpy()).as_matrix().reshape(2, 2, 3, 3)
    np.testing.assert_allclose(rotation_about(axis, angle), expected, atol=1e-15)


@pytest.mark.parametrize("axes", ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"])
def test_euler_angles_equal_scipy_and_come_back(axes):
    angles = torch.empty(200, 3, dtype=DTYPE).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))
    angles = angles * torch.tensor([math.pi, 1.57, math.pi])
    rotmat = euler_to_rotmat(axes, angles)
    expected = Rotation.from_euler(axes.upper(), angles.numpy()).as_matrix()
    np.testing.assert_allclose(rotmat, expected, atol=1e-14)
    torch.testing.assert_close(rotmat_to_euler(axes, rotmat), angles, atol=1e-12, rtol=0)


def test_euler_angles_where_two_axes_meet_still_give_the_rotation():
    angles = torch.tensor([[0.4, math.pi / 2, 0.3], [0.4, -math.pi / 2, 0.3]], dtype=DTYPE)
    rotmat = euler_to_rotmat("zyx", angles)
    again = rotmat_to_euler("zyx", rotmat)
    assert again.isfinite().all()
    torch.testing.assert_close(again[:, 1], angles[:, 1], atol=1e-7, rtol=0)


def test_twist_and_swing_give_the_rotation_and_the_swing_is_the_shortest():
    rotmat = rotvec_to_rotmat(random_rotvecs(300, scale=1.2))
    axis = torch.nn.functional.normalize(random_rotvecs(300).flip(0), dim=-1)
    swing, twist = swing_twist(rotmat, axis)
    torch.testing.assert_close(swing @ rotvec_to_rotmat(twist[:, None] * axis), rotmat)
    torch.testing.assert_close((rotmat_to_rotvec(swing) * axis).sum(-1), torch.zeros(300, dtype=DTYPE))
    moved = (rotmat @ axis[..., None]).squeeze(-1)
    between = (axis * moved).sum(-1).clamp(-1, 1).arccos()
    torch.testing.assert_close(rotmat_to_rotvec(swing).norm(dim=-1), between, atol=1e-7, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, -2.0, 3.1])
def test_a_turn_about_the_axis_is_all_twist(angle):
    angle = torch.tensor(angle, dtype=DTYPE)
    swing, twist = swing_twist(rotation_about("y", angle), torch.tensor([0, 1, 0], dtype=DTYPE))
    torch.testing.assert_close(twist, angle)
    torch.testing.assert_close(swing, torch.eye(3, dtype=DTYPE))


def test_interpolation_goes_the_shortest_way_at_an_even_pace():
    start, end = rotvec_to_rotmat(random_rotvecs(2, 50, scale=1.0))
    whole = rotmat_to_rotvec(start.mT @ end)
    for share in (0.0, 0.3, 1.0):
        middle = interpolate_rotmat(start, end, torch.full((50,), share, dtype=DTYPE))
        torch.testing.assert_close(rotmat_to_rotvec(start.mT @ middle), share * whole, atol=1e-12, rtol=0)


def test_body_axes_reach_opengl_and_opencv_cameras():
    forward, left, up = axes = torch.eye(3, dtype=DTYPE)
    torch.testing.assert_close(BODY_TO_OPENGL @ torch.stack([left, up, forward], 1), axes)
    right, down, away = -left, -up, -forward  # of a body that faces the camera, as its camera sees it
    torch.testing.assert_close(CAMERA_FROM_BODY @ torch.stack([-right, down, away], 1), axes)
    opencv_from_opengl = torch.diag(torch.tensor([1, -1, -1], dtype=DTYPE))
    torch.testing.assert_close(CAMERA_FROM_BODY, opencv_from_opengl @ BODY_TO_OPENGL)
    assert torch.linalg.det(CAMERA_FROM_BODY).item() == pytest.approx(1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_body_to_camera_equals_the_product(dtype):
    points = random_rotvecs(4, 5, dtype=dtype)
    assert torch.equal(body_to_camera(points), points @ CAMERA_FROM_BODY.to(dtype).T)


def test_a_body_at_rest_in_smpl_axes_stands_along_z_and_faces_x_in_body_world():
    root = rotvec_to_rotmat(smpl_pose_to_body_world(torch.zeros(72, dtype=DTYPE))[:3])
    up, forward = torch.eye(3, dtype=DTYPE)[1], torch.eye(3, dtype=DTYPE)[2]
    torch.testing.assert_close(root @ up, torch.tensor([0.0, 0.0, 1.0], dtype=DTYPE))
    torch.testing.assert_close(root @ forward, torch.tensor([1.0, 0.0, 0.0], dtype=DTYPE))


def test_pose_frames_turn_the_root_from_the_left_and_touch_nothing_else():
    pose = 0.8 * torch.randn(4, 5, 72, dtype=DTYPE, generator=torch.Generator().manual_seed(1))
    world = smpl_pose_to_body_world(pose)
    expected = BODY_TO_OPENGL.T @ rotvec_to_rotmat(pose[..., :3])
    torch.testing.assert_close(rotvec_to_rotmat(world[..., :3]), expected)
    assert torch.equal(world[..., 3:], pose[..., 3:])
    assert smpl_pose_to_body_world(pose.float()).dtype == torch.float32


@pytest.mark.parametrize(
    ("function", "shape", "message"),
    [
        (rotvec_to_rotmat, (5, 4), r"rotvec: expected shape \(\.\.\., 3\), got \(5, 4\)"),
        (rotmat_to_rotvec, (3,), r"rotmat: expected shape \(\.\.\., 3, 3\), got \(3,\)"),
        (smpl_pose_to_body_world, (2, 24, 3), r"pose: expected shape \(\.\.\., 72\), got \(2, 24, 3\)"),
    ],
)
def test_a_wrong_shape_is_named(function, shape, message):
    with pytest.raises(ValueError, match=message):
        function(torch.zeros(shape))


@pytest.mark.parametrize("axes", ["xyx", "xy", "abc", "xyzx"])
def test_axes_that_are_no_order_of_the_three_are_named(axes):
    for function, shape in ((euler_to_rotmat, (3,)), (rotmat_to_euler, (3, 3))):
        with pytest.raises(ValueError, match=f"axes: expected 'x', 'y' and 'z' in some order, got '{axes}'"):
            function(axes, torch.zeros(shape))
    with pytest.raises(ValueError, match="axis: expected 'x', 'y' or 'z', got 'w'"):
        rotation_about("w", torch.zeros(()))


# Two columns


def test_two_columns_of_a_rotation_give_it_back():
    rotmat = rotvec_to_rotmat(random_rotvecs(20, scale=1))
    columns = rotmat[..., :2].mT.flatten(-2)
    torch.testing.assert_close(rot6d_to_rotmat(columns), rotmat)
    # Neither their lengths nor what the second has of the first matter.
    columns[:, 3:] = 2 * columns[:, 3:] + 0.5 * columns[:, :3]
    columns[:, :3] *= 3
    torch.testing.assert_close(rot6d_to_rotmat(columns), rotmat)


def test_rot6d_passes_gradcheck():
    rot6d = torch.randn(3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    assert torch.autograd.gradcheck(rot6d_to_rotmat, (rot6d.requires_grad_(),))
