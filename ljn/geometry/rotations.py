"""Rotations as vectors and matrices, and the one place where body, SMPL and camera axes meet."""

import torch
from torch import Tensor

BODY_TO_OPENGL = torch.tensor([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)
"""R of Eq. 3.5, (3, 3): body world (x forward, y left, z up) to OpenGL's camera axes (x right, y up,
looking along -z). SMPL's own rest frame (x to the body's left, y up, z forward) has these axes too."""

CAMERA_FROM_BODY = torch.tensor([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], dtype=torch.float64)
"""Eq. 3.5 with OpenCV's camera axes (x right, y down, z forward), (3, 3): `BODY_TO_OPENGL` with its y and
z turned round. A body that faces along +x looks into the camera."""

_SMALL_SQUARE = 1e-5
"""Below this squared angle (or squared sine of half of it) Taylor series are exact to float64 rounding."""


def rotvec_to_rotmat(rotvec: Tensor) -> Tensor:
    """Rotation matrices of rotation vectors: Rodrigues' formula, smooth everywhere, also at zero.

    Args:
        rotvec: `(..., 3)`, axis times angle, radians.

    Returns:
        `(..., 3, 3)`, acting on column vectors.
    """
    _check_shape("rotvec", rotvec, (3,))
    square = (rotvec * rotvec).sum(-1)[..., None, None]  # (..., 1, 1)
    is_small = square < _SMALL_SQUARE
    # The branch not taken must stay finite as well: `where` multiplies its gradient by zero.
    angle = torch.where(is_small, torch.ones_like(square), square).sqrt()
    sine = torch.where(is_small, 1 - square / 6 + square**2 / 120, angle.sin() / angle)
    versine = torch.where(is_small, 0.5 - square / 24 + square**2 / 720, 2 * ((angle / 2).sin() / angle) ** 2)

    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    outer = rotvec[..., :, None] * rotvec[..., None, :]
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return (1 - versine * square) * eye + sine * cross + versine * outer


def rotmat_to_rotvec(rotmat: Tensor) -> Tensor:
    """Rotation vectors of rotation matrices, through quaternions; safe at the identity and half turns.

    Args:
        rotmat: `(..., 3, 3)` rotation matrices.

    Returns:
        `(..., 3)`, radians, of length at most pi. At a half turn either of the two signs may come.
    """
    _check_shape("rotmat", rotmat, (3, 3))
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotmat.flatten(-2).unbind(-1)
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m02 + m20, m12 + m21
    squares = torch.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1
    )
    ww, xx, yy, zz = squares.unbind(-1)
    # 4 q q^T: each row is a multiple of q; the row of the largest component is never near zero.
    products = torch.stack([ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz], -1)
    largest = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = products.unflatten(-1, (4, 4)).gather(-2, largest).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)

    real, imaginary = quaternion.split([1, 3], dim=-1)
    square = (imaginary * imaginary).sum(-1, keepdim=True)
    is_small = square < _SMALL_SQUARE
    sine = torch.where(is_small, torch.ones_like(square), square).sqrt()
    scale = torch.where(is_small, 2 + square / 3 + 3 * square**2 / 20, 2 * torch.atan2(sine, real) / sine)
    return scale * imaginary


def rot6d_to_rotmat(rot6d: Tensor) -> Tensor:
    """Rotation matrices from their first two columns, made orthonormal (Zhou et al. 2019).

    Args:
        rot6d: `(..., 6)`: first column, then second; any length, not parallel.

    Returns:
        `(..., 3, 3)`.
    """
    _check_shape("rot6d", rot6d, (6,))
    first, second = rot6d.unflatten(-1, (2, 3)).unbind(-2)
    x = torch.nn.functional.normalize(first, dim=-1)
    y = torch.nn.functional.normalize(second - (x * second).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


def rotation_about(axis: str, angle: Tensor) -> Tensor:
    """Rotation matrices `(..., 3, 3)` about the "x", "y" or "z" axis.

    `angle` is `(...)`, radians, counter-clockwise seen from the axis' tip.
    """
    if axis not in ("x", "y", "z"):
        raise ValueError(f"axis: expected 'x', 'y' or 'z', got {axis!r}")
    unit = torch.eye(3, dtype=angle.dtype, device=angle.device)["xyz".index(axis)]
    return rotvec_to_rotmat(angle[..., None] * unit)


def euler_to_rotmat(axes: str, angles: Tensor) -> Tensor:
    """Rotation matrices from angles about three different coordinate axes.

    Args:
        axes: The axes in the order of the product, such as "xzy": R = R_x(a) R_z(b) R_y(c); every turn is about
            the axis as the turns before it have left it.
        angles: `(..., 3)`, radians, in the order of `axes`.

    Returns:
        `(..., 3, 3)`, acting on column vectors.
    """
    _check_axes(axes)
    _check_shape("angles", angles, (3,))
    i, j, k = ("xyz".index(axis) for axis in axes)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    (ca, cb, cc), (sa, sb, sc) = angles.cos().unbind(-1), (sign * angles.sin()).unbind(-1)
    entries = {
        (i, i): cb * cc, (i, j): -cb * sc, (i, k): sb,
        (j, i): ca * sc + sa * sb * cc, (j, j): ca * cc - sa * sb * sc, (j, k): -sa * cb,
        (k, i): sa * sc - ca * sb * cc, (k, j): sa * cc + ca * sb * sc, (k, k): ca * cb,
    }  # fmt: skip
    ordered = [entries[row, column] for row in range(3) for column in range(3)]
    return torch.stack(ordered, -1).unflatten(-1, (3, 3))


def rotmat_to_euler(axes: str, rotmat: Tensor) -> Tensor:
    """Angles about three different coordinate axes: the inverse of `euler_to_rotmat`.

    Args:
        axes: The axes in the order of the product; see `euler_to_rotmat`.
        rotmat: `(..., 3, 3)` rotation matrices.

    Returns:
        `(..., 3)`, radians; the second lies in [-pi/2, pi/2], and where it reaches an end only the sum or the
        difference of the other two is determined.
    """
    _check_axes(axes)
    _check_shape("rotmat", rotmat, (3, 3))
    i, j, k = ("xyz".index(axis) for axis in axes)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    first = torch.atan2(-sign * rotmat[..., j, k], rotmat[..., k, k])
    cosine = torch.hypot(rotmat[..., i, i], rotmat[..., i, j])
    second = torch.atan2(sign * rotmat[..., i, k], cosine)
    third = torch.atan2(-sign * rotmat[..., i, j], rotmat[..., i, i])
    return torch.stack([first, second, third], -1)


def swing_twist(rotmat: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Splits rotations into a turn about an axis and the shortest rotation that then brings the axis to its place.

    Args:
        rotmat: `(..., 3, 3)` rotation matrices.
        axis: `(..., 3)` unit vectors.

    Returns:
        The swing `(..., 3, 3)` and the angle of the twist `(...)`, radians in [-pi, pi]: R = swing R_axis(twist).
        Where R turns the axis round to its opposite, the split is not determined.
    """
    _check_shape("rotmat", rotmat, (3, 3))
    _check_shape("axis", axis, (3,))
    rotvec = rotmat_to_rotvec(rotmat)
    # Half the rotation vector has the direction of the quaternion's imaginary part and its angle.
    half = rotvec.norm(dim=-1, keepdim=True) / 2
    along = (rotvec * axis).sum(-1) / 2 * torch.sinc(half / torch.pi).squeeze(-1)
    twist = 2 * torch.atan2(along, half.cos().squeeze(-1))
    return rotmat @ rotvec_to_rotmat(-twist[..., None] * axis), twist


def interpolate_rotmat(start: Tensor, end: Tensor, share: Tensor) -> Tensor:
    """Rotations `(..., 3, 3)`, a share `(...)` of the shortest way from `start` to `end` (spherical interpolation)."""
    return start @ rotvec_to_rotmat(share[..., None] * rotmat_to_rotvec(start.mT @ end))


def smpl_pose_to_body_world(pose: Tensor) -> Tensor:
    """A pose in SMPL's axes (y up, z forward), turned into body world (z up, x forward).

    theta_0 <- log(R^T exp(theta_0)) with R of Eq. 3.5; the other joints are relative and stay.

    Args:
        pose: `(..., 72)`, axis-angle, radians, mapping SMPL's rest frame into SMPL's axes.

    Returns:
        `(..., 72)`, mapping SMPL's rest frame into body world.
    """
    _check_shape("pose", pose, (72,))
    root, others = pose.split([3, 69], dim=-1)
    return torch.cat([rotmat_to_rotvec(BODY_TO_OPENGL.T.to(pose) @ rotvec_to_rotmat(root)), others], dim=-1)


def body_to_camera(points: Tensor) -> Tensor:
    """Points or directions `(..., 3)` in body world, in the camera's axes: `CAMERA_FROM_BODY` times each.

    The matrix exchanges axes and signs, which takes a tenth of the product's time and gives the same numbers.
    """
    _check_shape("points", points, (3,))
    x, y, z = points.unbind(-1)
    return torch.stack([y, -z, -x], -1)


def _check_axes(axes: str) -> None:
    if sorted(axes) != ["x", "y", "z"]:
        raise ValueError(f"axes: expected 'x', 'y' and 'z' in some order, got {axes!r}")


def _check_shape(name: str, value: Tensor, last: tuple[int, ...]) -> None:
    if value.shape[-len(last) :] != last:
        expected = ", ".join(["...", *map(str, last)])
        raise ValueError(f"{name}: expected shape ({expected}), got {tuple(value.shape)}")
