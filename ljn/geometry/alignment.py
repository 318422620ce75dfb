"""Alignment of one point set with another, for metrics that forgive a global transform."""

import torch
from torch import Tensor


def procrustes_align(source: Tensor, target: Tensor) -> Tensor:
    """Return `source` after the similarity transform that brings it closest to `target`.

    The transform (a rotation without reflection, one scale, a translation) minimises the sum of squared
    distances in closed form: Umeyama, "Least-squares estimation of transformation parameters between two
    point patterns", PAMI 1991, Eq. 40-42. Where it is not unique (collinear or equal points) the result
    still is for points on a line, and equal points land on the target's mean.

    Args:
        source: `(..., K, 3)`, any unit and frame.
        target: `(..., K, 3)`, the same shape, unit and frame.

    Returns:
        `(..., K, 3)` in the target's unit and frame and the source's dtype; computed in float64. A set with
        a non-finite coordinate, in `source` or `target`, comes back as NaN.
    """
    if source.shape != target.shape or source.shape[-1:] != (3,) or source.ndim < 2:
        raise ValueError(
            "source and target must be of the same shape (..., K, 3), "
            f"got {tuple(source.shape)} and {tuple(target.shape)}"
        )
    x, y = source.double(), target.double()
    x_mean, y_mean = x.mean(-2, keepdim=True), y.mean(-2, keepdim=True)
    x, y = x - x_mean, y - y_mean

    covariance = y.mT @ x  # (..., 3, 3)
    is_finite = covariance.isfinite().all(-1).all(-1)
    # LAPACK raises on one NaN, and would take the whole batch with it.
    u, singular, vh = torch.linalg.svd(covariance.where(is_finite[..., None, None], 0.0))
    signs = torch.ones_like(singular)
    signs[..., -1] = torch.linalg.det(u @ vh).sign()
    rotation = (u * signs[..., None, :]) @ vh  # (..., 3, 3)

    variance = x.square().sum((-2, -1))
    # Equal source points have no variance and no covariance: the scale is then 0, not 0 / 0.
    scale = (singular * signs).sum(-1) / variance.clamp_min(torch.finfo(variance.dtype).tiny)
    scale = scale.where(is_finite, torch.nan)
    return (scale[..., None, None] * (x @ rotation.mT) + y_mean).to(source.dtype)


def root_align(joints: Tensor, root_index: int) -> Tensor:
    """Return `joints` relative to the root joint.

    Args:
        joints: `(..., K, 3)`, any unit and frame.
        root_index: index of the root among the K joints.

    Returns:
        `(..., K, 3)`, same unit and axes, the root at the origin.
    """
    return joints - joints[..., root_index, None, :]
