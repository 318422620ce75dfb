"""PointNet (Qi et al. 2017; Fig. 3.2), without T-nets and batch normalisation, with PReLU."""

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor, nn

from ljn.nets.layers import PRELU_SLOPE, apply_shared, perceive_and_pool, perceptron


class PointFeatures(NamedTuple):
    """Features of a cloud.

    Attributes:
        local: `(B, N, C_local)`, of each point by itself.
        pooled: `(B, C_global)`, of the whole cloud.
    """

    local: Tensor
    pooled: Tensor


class PointNet(nn.Module):
    """The trunk: a shared perceptron to local features, another one and a max pool to the global feature.

    Args:
        in_channels: Channels of a point.
        local_channels: Widths up to the local feature.
        global_channels: Widths from there to the global feature.
        carried_channels: How many channels, which all points of a cloud share, are given beside the local features,
            too; None: they reach the global feature through those alone.
        slope: Of the PReLUs' negative sides before training.
    """

    def __init__(
        self,
        in_channels: int = 6,
        local_channels: Sequence[int] = (64, 64),
        global_channels: Sequence[int] = (64, 128, 1024),
        carried_channels: int | None = None,
        slope: float = PRELU_SLOPE,
    ) -> None:
        super().__init__()
        self.local = perceptron([in_channels, *local_channels], slope=slope)
        self.carried_channels = carried_channels or 0
        self.lift = perceptron(
            [local_channels[-1] + self.carried_channels, *global_channels],
            last_activation=False,
            slope=slope,
        )
        self.lift_activation = nn.PReLU(init=slope)
        self.out_channels = global_channels[-1]

    def forward(self, points: Tensor, shared: Tensor | None = None) -> PointFeatures:
        """`PointFeatures`; the global feature ignores the order of the points.

        Args:
            points: `(B, N, in_channels)`, or without the last channels, which are `shared`.
            shared: `(B, C)`, channels which all points of a cloud have in common; C is `carried_channels` unless
                that is None.
        """
        local = apply_shared(self.local, points, shared)
        carried = shared if self.carried_channels else None
        return PointFeatures(local, perceive_and_pool(self.lift, self.lift_activation, local, carried))

    def global_feature(self, points: Tensor, shared: Tensor | None = None) -> Tensor:
        """The global feature `(B, out_channels)`, as `PointNet2.global_feature`; see `forward`."""
        return self(points, shared).pooled
