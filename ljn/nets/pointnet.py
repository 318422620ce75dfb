"""PointNet (Qi et al. 2017; Fig. 3.2), without T-nets and batch normalisation, with PReLU."""

from collections.abc import Sequence
from typing import NamedTuple, cast

from torch import Tensor, nn

from ljn.nets.layers import activate_and_pool, perceptron, shared_linear


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
    """

    def __init__(
        self,
        in_channels: int = 6,
        local_channels: Sequence[int] = (64, 64),
        global_channels: Sequence[int] = (64, 128, 1024),
    ) -> None:
        super().__init__()
        self.local = perceptron([in_channels, *local_channels])
        self.lift = perceptron([local_channels[-1], *global_channels], last_activation=False)
        self.lift_activation = nn.PReLU()
        self.out_channels = global_channels[-1]

    def forward(self, points: Tensor, shared: Tensor | None = None) -> PointFeatures:
        """`PointFeatures`; the global feature ignores the order of the points.

        Args:
            points: `(B, N, in_channels)`, or without the last channels, which are `shared`.
            shared: `(B, C)`, channels which all points of a cloud have in common.
        """
        first, *rest = self.local
        local = shared_linear(cast(nn.Linear, first), points, shared)
        for layer in rest:
            local = layer(local)
        return PointFeatures(local, activate_and_pool(self.lift(local), self.lift_activation, 1))

    def global_feature(self, points: Tensor, shared: Tensor | None = None) -> Tensor:
        """The global feature `(B, out_channels)`, as `PointNet2.global_feature`; see `forward`."""
        return self(points, shared).pooled
