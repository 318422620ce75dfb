"""Heatmaps of keypoints: made as targets, read as positions.

A map's cell covers `stride` pixels of the image that it belongs to; coordinates are pixels of that image, whose centres
are whole numbers, so that cell i lies around pixel `stride * (i + 0.5) - 0.5`.
"""

import torch
from torch import Tensor

DECODINGS = ("quarter", "parabola")
_LEAST = 1e-6  # of a heatmap's values before their logarithm
_SHIFT = 0.25  # cells, of `quarter`


def gaussian_heatmaps(keypoints: Tensor, sigma: float, size: tuple[int, int], stride: int) -> Tensor:
    """Maps with a Gaussian of height 1 around each keypoint.

    Args:
        keypoints: `(..., K, 2)`, u and v, pixels of the image; they may lie outside of it.
        sigma: Standard deviation, cells.
        size: Height and width of the maps, cells.
        stride: Pixels of a cell.

    Returns:
        `(..., K, h, w)`.
    """
    cells = (keypoints + 0.5) / stride - 0.5
    height, width = size
    across, down = (
        torch.exp(-((torch.arange(length).to(cells) - cells[..., axis, None]) ** 2) / (2 * sigma**2))
        for axis, length in ((0, width), (1, height))
    )
    return down[..., :, None] * across[..., None, :]


def decode_heatmaps(heatmaps: Tensor, stride: int, decoding: str = "parabola") -> tuple[Tensor, Tensor]:
    """Where the peaks are, and how high.

    Args:
        heatmaps: `(..., K, h, w)`.
        stride: Pixels of a cell.
        decoding: `quarter`: a quarter of a cell from the highest cell towards the second highest (Chen et al. 2018,
            "Cascaded Pyramid Network for Multi-Person Pose Estimation"); or `parabola`: the top of parabolas through
            the logarithms of the highest cell and its neighbours, exact for a Gaussian (Zhang et al. 2020,
            "Distribution-Aware Coordinate Representation", along each axis by itself).

    Returns:
        `(..., K, 2)`, pixels of the image; and `(..., K)`, the highest cells' values between 0 and 1.

    Raises:
        ValueError: There is no such decoding.
    """
    if decoding not in DECODINGS:
        raise ValueError(f"decoding: expected one of {', '.join(DECODINGS)}, got '{decoding}'")
    width = heatmaps.shape[-1]
    flat = heatmaps.flatten(-2)
    height_of_peak, peak = flat.max(-1)
    cell = _cell(peak, width)
    if decoding == "quarter":
        rest = flat.scatter(-1, peak[..., None], -torch.inf)
        towards = _cell(rest.argmax(-1), width) - cell
        cell = cell + _SHIFT * towards / towards.norm(dim=-1, keepdim=True)
    else:
        cell = cell + torch.stack([_top(heatmaps, peak, axis) for axis in (-1, -2)], -1)
    return stride * (cell + 0.5) - 0.5, height_of_peak.clamp(0, 1)


def _cell(index: Tensor, width: int) -> Tensor:
    """Column and row `(..., 2)` of cells numbered row by row."""
    return torch.stack([index % width, index // width], -1).float()


def _top(heatmaps: Tensor, peak: Tensor, axis: int) -> Tensor:
    """How far from the highest cell the top of a parabola through it and its neighbours lies; within half a cell.

    At the border, where a neighbour is missing, 0.
    """
    length, step = heatmaps.shape[axis], 1 if axis == -1 else heatmaps.shape[-1]
    place = peak % length if axis == -1 else peak // heatmaps.shape[-1]
    logs = heatmaps.clamp(min=_LEAST).log().flatten(-2)
    last = logs.shape[-1] - 1
    before, here, after = (
        logs.gather(-1, (peak + offset).clamp(0, last)[..., None])[..., 0] for offset in (-step, 0, step)
    )
    curvature = before - 2 * here + after
    is_inside = (place > 0) & (place < length - 1) & (curvature < 0)
    return torch.where(is_inside, (before - after) / (2 * curvature), 0.0).clamp(-0.5, 0.5)
