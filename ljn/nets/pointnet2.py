"""PointNet++ with single-scale grouping (Qi et al. 2017), without batch normalisation, with PReLU."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ljn.geometry.points import ball_group, farthest_point_sampling, gather_points
from ljn.nets.layers import PRELU_SLOPE, activate_and_pool, apply_shared, initialise, perceptron


class SetAbstraction(nn.Module):
    """One set abstraction: spread centres over the cloud, run a small PointNet on the ball around each.

    Args:
        num_centres: Number of centres, taken by farthest point sampling; at most the number of points.
        radius_m: Radius of the balls, metres.
        group_size: Points in a ball.
        in_channels: Channels of a point beside its position.
        channels: Widths of the shared perceptron.
        relative_to_radius: Whether positions in a ball are in units of its radius, or in metres.

    Raises:
        ValueError: `num_centres` or `group_size` is less than 1.
    """

    def __init__(
        self,
        num_centres: int,
        radius_m: float,
        group_size: int,
        in_channels: int,
        channels: Sequence[int],
        relative_to_radius: bool = True,
    ) -> None:
        super().__init__()
        for name, value in (("num_centres", num_centres), ("group_size", group_size)):
            if value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")
        self.num_centres = num_centres
        self.group_size = group_size
        self.unit_m = radius_m if relative_to_radius else 1.0
        self.register_buffer("radius", torch.tensor([radius_m]), persistent=False)
        self.radius: Tensor
        # One layer on position and feature together, in two parts.
        fan_in = 3 + in_channels
        self.position = initialise(nn.Linear(3, channels[0], bias=False), PRELU_SLOPE, fan_in=fan_in)
        self.feature = initialise(nn.Linear(in_channels, channels[0]), PRELU_SLOPE, fan_in=fan_in)
        self.first_activation = nn.PReLU()
        self.rest = perceptron(channels, last_activation=False)
        self.last_activation = nn.PReLU()

    def forward(
        self, positions: Tensor, features: Tensor, shared: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Centres and their features.

        Args:
            positions: `(B, N, 3)`, metres.
            features: `(B, N, in_channels)`, or without the last channels, which are `shared`.
            shared: `(B, C)`, those which all points of a cloud have in common.

        Returns:
            Positions `(B, M, 3)` and features `(B, M, channels[-1])` of the centres.
        """
        centres = gather_points(positions, farthest_point_sampling(positions, self.num_centres))
        radii = self.radius.expand(self.num_centres)
        index = ball_group(positions, centres, radii, self.group_size)  # (B, M, n)
        # The first layer is linear in a point's position and feature: once for each point, not once for each
        # of its appearances in a ball; the ball's centre is taken off afterwards.
        hidden = apply_shared([self.feature], features, shared) + self.position(positions / self.unit_m)
        hidden = gather_points(hidden, index) - self.position(centres / self.unit_m)[:, :, None]
        hidden = self.rest(self.first_activation(hidden))  # (B, M, n, C)
        return centres, activate_and_pool(hidden, self.last_activation, 2)


class PointNet2(nn.Module):
    """The trunk: set abstractions, then a PointNet over the last centres: one feature for the whole cloud.

    Its sampling begins at a geometric point, so it is deterministic and does not depend on the order of the
    points, unless a ball holds more than `group_sizes` of them.

    Args:
        in_channels: Channels of a point, its position included.
        num_centres: Centres of each set abstraction.
        radii_m: Their balls' radii, metres.
        group_sizes: Their balls' numbers of points.
        channels: Their widths.
        global_channels: Widths of the last PointNet, up to the global feature.
        relative_to_radius: See `SetAbstraction`.
        carried_channels: How many channels, which all points of a cloud share, the last centres carry beside their
            features, as the points do; None: they reach the global feature through the points alone.

    Raises:
        ValueError: The lists differ in length, or a number of centres or points is less than 1.
    """

    def __init__(
        self,
        in_channels: int = 6,
        num_centres: Sequence[int] = (512, 128),
        radii_m: Sequence[float] = (0.2, 0.4),
        group_sizes: Sequence[int] = (32, 64),
        channels: Sequence[Sequence[int]] = ((64, 64, 128), (128, 128, 256)),
        global_channels: Sequence[int] = (256, 512, 1024),
        relative_to_radius: bool = True,
        carried_channels: int | None = None,
    ) -> None:
        super().__init__()
        lengths = {len(num_centres), len(radii_m), len(group_sizes), len(channels)}
        if len(lengths) != 1:
            raise ValueError(
                "num_centres, radii_m, group_sizes and channels: expected one entry for each set abstraction, got "
                f"{len(num_centres)}, {len(radii_m)}, {len(group_sizes)} and {len(channels)}"
            )
        widths = [in_channels, *(layers[-1] for layers in channels)]
        self.abstractions = nn.ModuleList(
            SetAbstraction(number, radius, size, width, layers, relative_to_radius)
            for number, radius, size, width, layers in zip(
                num_centres, radii_m, group_sizes, widths, channels
            )
        )
        self.carried_channels = carried_channels or 0
        self.lift = perceptron(
            [3 + widths[-1] + self.carried_channels, *global_channels], last_activation=False
        )
        self.lift_activation = nn.PReLU()
        self.out_channels = global_channels[-1]

    def forward(self, points: Tensor, shared: Tensor | None = None) -> Tensor:
        """The global feature `(B, global_channels[-1])`.

        Args:
            points: `(B, N, in_channels)`, position first, metres; or without the last channels, which are `shared`.
            shared: `(B, C)`, channels which all points of a cloud have in common; C is `carried_channels` unless
                that is None.
        """
        positions, features = points[..., :3], points
        for number, abstraction in enumerate(self.abstractions):
            positions, features = abstraction(positions, features, None if number else shared)
        carried = shared if self.carried_channels else None
        hidden = apply_shared(self.lift, torch.cat([positions, features], -1), carried)
        return activate_and_pool(hidden, self.lift_activation, 1)

    def global_feature(self, points: Tensor, shared: Tensor | None = None) -> Tensor:
        """The global feature `(B, out_channels)`, as `PointNet.global_feature`; see `forward`."""
        return self(points, shared)
