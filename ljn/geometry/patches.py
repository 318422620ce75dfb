"""Square patches of a depth image around points in space, cut into squares."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

SQUARE = 4  # samples along a square's side
NEAREST_M = 0.1  # of the points: nearer ones are taken to be there
_CLIP = 2.0  # of depths, in their units


@torch.no_grad()
def patch_squares(
    crop: Tensor,
    crop_camera: Tensor,
    points: Tensor,
    sizes_m: Sequence[float],
    units_m: Sequence[float],
    patch_px: int,
) -> Tensor:
    """Patches of several widths around points, in squares of 4 x 4 samples, row by row.

    On a CPU a compiled kernel gathers them, which follows the tensor form's arithmetic to the last bit.

    Args:
        crop: `(B, P, P)`, depth, metres, 0 outside the body.
        crop_camera: `(B, 4)`: fx, fy, cx, cy.
        points: `(B, K, 3)`, metres, camera frame.
        sizes_m: Width of the patches at each of S scales, see `depth_patches`.
        units_m: Unit of the depths at each scale, metres.
        patch_px: Samples along a patch's side, p, a multiple of 4.

    Returns:
        `(B, K, (p / 4)^2, S * 2 * 16)`: of each square, for each scale, the 16 depths, then the 16 of the mask.
    """
    if crop.device.type != "cpu" or crop.dtype != torch.float32:
        patches = [
            depth_patches(crop, crop_camera, points, size, unit, patch_px)
            for size, unit in zip(sizes_m, units_m)
        ]
        return torch.cat([_squares(each) for each in patches], -1)
    from ljn.geometry import kernels  # numba takes its time to import

    side = patch_px // SQUARE
    out = np.zeros((*points.shape[:2], side * side, len(sizes_m) * 2 * SQUARE**2), np.float32)
    offsets = ((torch.arange(patch_px) + 0.5) / patch_px - 0.5).numpy()
    image, camera, around = (value.detach().contiguous().numpy() for value in (crop, crop_camera, points))
    scales = np.array([sizes_m, units_m], np.float32).T.copy()
    limits = np.array([NEAREST_M, _CLIP], np.float32)
    kernels.patch_squares(image, camera, around, scales, offsets, limits, out)
    return torch.from_numpy(out)


@torch.no_grad()
def depth_patches(
    crop: Tensor, crop_camera: Tensor, points: Tensor, size_m: float, unit_m: float, patch_px: int
) -> Tensor:
    """Square patches of a depth image around points: the nearest pixel's depth beside the point's, and the mask.

    Args:
        crop: `(B, P, P)`, metres, 0 outside the body.
        crop_camera: `(B, 4)`.
        points: `(B, K, 3)`, metres, camera frame.
        size_m: Width of a patch at its point's depth, metres.
        unit_m: Unit of the depths, metres; they are clipped to +-2 units.
        patch_px: Samples along its side, p.

    Returns:
        `(B, K, 2, p, p)`: depth less the point's (0 outside the body), and 1 on the body.
    """
    side = crop.shape[-1]
    fx, fy, cx, cy = crop_camera[:, None].unbind(-1)  # (B, 1) each
    x, y, z = points.unbind(-1)
    z = z.clamp(min=NEAREST_M)
    offsets = (torch.arange(patch_px, device=crop.device) + 0.5) / patch_px - 0.5
    column = (x / z * fx + cx)[..., None] + offsets * (size_m * fx / z)[..., None]  # (B, K, p)
    row = (y / z * fy + cy)[..., None] + offsets * (size_m * fy / z)[..., None]
    column, row = column.round().long(), row.round().long()
    is_inside = ((column >= 0) & (column < side))[..., None, :] & ((row >= 0) & (row < side))[..., None]
    index = row.clamp(0, side - 1)[..., None] * side + column.clamp(0, side - 1)[..., None, :]  # (B, K, p, p)
    depth = crop.flatten(1).gather(1, index.flatten(1)).view_as(index)
    is_body = is_inside & (depth > 0)
    relative = ((depth - z[..., None, None]) / unit_m).clamp(-_CLIP, _CLIP)
    return torch.stack([torch.where(is_body, relative, 0.0), is_body.to(crop.dtype)], 2)


def _squares(patches: Tensor) -> Tensor:
    """Patches `(B, K, 2, p, p)` cut into squares: `(B, K, squares, 2 * 4 * 4)`."""
    cut = patches.unflatten(-1, (-1, SQUARE)).unflatten(-3, (-1, SQUARE))  # (B, K, 2, rows, 4, columns, 4)
    return cut.permute(0, 1, 3, 5, 2, 4, 6).flatten(4).flatten(2, 3)
