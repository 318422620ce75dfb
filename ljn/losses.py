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
