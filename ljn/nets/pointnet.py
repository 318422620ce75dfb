"""PointNet (Qi et al. 2017; Fig. 3.2), without T-nets and batch normalisation, with PReLU."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ljn.nets.layers import PRELU_SLOPE, perceive_and_pool, perceptron


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
        slope: Of the PReLUs' negative sides before training.
    """

    def __init__(
        self,
        in_channels: int = 6,
        local_channels: Sequence[int] = (64, 64),
        global_channels: Sequence[int] = (64, 128, 1024),
        slope: float = PRELU_SLOPE,
    ) -> None:
        super().__init__()
        self.local = perceptron([in_channels, *local_channels], slope=slope)
        self.lift = perceptron([local_channels[-1], *global_channels], last_activation=False, slope=slope)
        self.lift_activation = nn.PReLU(init=slope)
        self.out_channels = global_channels[-1]

    def forward(self, points: Tensor, shared: Tensor | None = None) -> PointFeatures:
        """Features of a cloud; the global one ignores the order of the points.

        Args:
            points: `(B, N, C)`.
            shared: `(B, in_channels - C)`, what every point of a cloud carries after its own channels; it is
                multiplied once for the cloud, not once for each point: the same sum, a part of the work.
        """
        if shared is None:
            local = self.local(points)
        else:
            first: Any = self.local[0]
            own_weight, shared_weight = first.weight.split([points.shape[-1], shared.shape[-1]], -1)
            hidden = torch.baddbmm(
                functional.linear(shared, shared_weight, first.bias)[:, None],
                points,
                own_weight.T.expand(len(points), -1, -1),
            )
            local = self.local[1:](hidden)
        return PointFeatures(local, perceive_and_pool(self.lift, self.lift_activation, local))

    def global_feature(self, points: Tensor) -> Tensor:
        """`(B, N, in_channels)` -> `(B, out_channels)`, as `PointNet2.global_feature`."""
        return self(points).pooled
