"""Training losses."""

from torch import Tensor


def joint_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return Eq. 3.6, the squared distances summed over a sample's joints, averaged over the batch.

    The average is ours: the thesis writes the loss of one sample.

    Args:
        pred: `(..., K, 3)`, metres.
        target: `(..., K, 3)`, metres, the same frame.

    Returns:
        Scalar, square metres.
    """
    if pred.shape != target.shape:
        raise ValueError(
            f"pred and target must be of the same shape, got {tuple(pred.shape)} and {tuple(target.shape)}"
        )
    return (pred - target).square().sum((-2, -1)).mean()


def mesh_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Return Eq. 3.7, the mean squared distance of the vertices, summed over iterations, averaged over the batch.

    The average over the batch is ours: the thesis writes the loss of one sample.

    Args:
        pred: `(T, B, V, 3)`, metres, body frame: the mesh after each of T iterations.
        target: `(B, V, 3)`, metres, body frame.

    Returns:
        Scalar, square metres.
    """
    if pred.ndim != 4 or pred.shape[1:] != target.shape:
        raise ValueError(
            f"expected pred (T, B, V, 3) and target (B, V, 3), got {tuple(pred.shape)} and {tuple(target.shape)}"
        )
    return (pred - target).square().sum(-1).mean((1, 2)).sum()
