"""LJN_jd (section 3.3.1, Fig. 3.4): a trunk on the whole cloud and a small network around each joint."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ljn.body.skeleton import NUM_JOINTS
from ljn.geometry.points import ball_group, distance_matrix, gather_points
from ljn.nets.detector import CloudDetector
from ljn.nets.layers import (
    OUTPUT_SCALE,
    StackedLinear,
    StackedPReLU,
    activate_and_pool,
    initialise_for_prelu,
    stacked_perceptron,
)
from ljn.nets.pointnet import PointNet


class LocalJointNetwork(CloudDetector):
    """The proposed joint detector.

    For joint i: `group_size` points within `radii_m[i]` of its initial position; each brings its position
    relative to that joint, its local feature, the cloud's global feature and row i of the initial joints'
    distance matrix. Sub-network i, a PointNet classifier, gives the output of joint i.

    Args:
        radii_m: Ball radius of each of the 24 joints, metres.
        group_size: Points in a group (l' of the thesis).
        relative_to_radius: Whether relative positions are in units of the ball's radius, or in metres: small
            beside the other inputs, and learning is then much slower.
        edm: Whether points carry the row of the distance matrix (off: the ablation "w/o EDM").
        in_channels: Channels of a point.
        local_channels: Trunk widths up to the local feature.
        global_channels: Trunk widths from there to the global feature.
        group_channels: Widths of a sub-network's shared perceptron, before its max pool.
        head_channels: Hidden widths of a sub-network's head.
        output: See `CloudDetector`.

    Raises:
        ValueError: `radii_m` does not hold 24 positive numbers.
    """

    def __init__(
        self,
        radii_m: Sequence[float],
        group_size: int = 128,
        relative_to_radius: bool = True,
        edm: bool = True,
        in_channels: int = 6,
        local_channels: Sequence[int] = (64, 64),
        global_channels: Sequence[int] = (64, 128, 1024),
        group_channels: Sequence[int] = (64, 128, 1024),
        head_channels: Sequence[int] = (512, 256),
        output: str = "offset",
    ) -> None:
        super().__init__(output)
        if len(radii_m) != NUM_JOINTS or min(radii_m) <= 0:
            raise ValueError(
                f"radii_m: expected {NUM_JOINTS} positive numbers, one for each joint in SMPL's order, got "
                f"{len(radii_m)}: {list(radii_m)}"
            )
        if group_size < 1:
            raise ValueError(f"group_size: expected at least 1, got {group_size}")
        self.register_buffer("radii", torch.tensor(radii_m, dtype=torch.float32), persistent=False)
        self.radii: Tensor
        self.group_size = group_size
        self.relative_to_radius = relative_to_radius
        self.edm = edm
        self.trunk = PointNet(in_channels, local_channels, global_channels)
        self.num_local = 3 + local_channels[-1]
        num_shared = global_channels[-1] + (NUM_JOINTS if edm else 0)
        self.first = StackedLinear(NUM_JOINTS, self.num_local + num_shared, group_channels[0])
        parts = [3, local_channels[-1], global_channels[-1], *([NUM_JOINTS] if edm else [])]
        initialise_for_prelu(self.first, parts=parts)
        self.first_activation = StackedPReLU(NUM_JOINTS)
        self.group = stacked_perceptron(NUM_JOINTS, group_channels, last_activation=False)
        self.group_activation = StackedPReLU(NUM_JOINTS)
        self.head = stacked_perceptron(
            NUM_JOINTS,
            [group_channels[-1], *head_channels, 3],
            last_activation=False,
            last_scale=OUTPUT_SCALE,
        )

    def regress(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """See `CloudDetector.regress`."""
        batch = len(points)
        local, pooled = self.trunk(points)
        index = ball_group(points[..., :3], initial_joints, self.radii, self.group_size)  # (B, K, n)
        grouped = gather_points(torch.cat([points[..., :3], local], -1), index)  # (B, K, n, 3 + C)
        position, feature = grouped.split([3, local.shape[-1]], -1)
        relative = position - initial_joints[:, :, None]
        if self.relative_to_radius:
            relative = relative / self.radii[:, None, None]
        grouped = torch.cat([relative, feature], -1).transpose(0, 1)  # (K, B, n, 3 + C)

        hidden = self._first_layer(grouped, pooled, initial_joints)  # (K, B * n, C')
        hidden = self.group(hidden).unflatten(1, (batch, self.group_size))
        features = activate_and_pool(hidden, self.group_activation, 2)  # (K, B, C'')
        return self.head(features).transpose(0, 1)

    def _first_layer(self, grouped: Tensor, pooled: Tensor, initial_joints: Tensor) -> Tensor:
        """The first layer of every sub-network on `[position, local, global, EDM row]` of every point.

        What a group's points share (the global feature, the row) is multiplied once for the group, not once
        for each point: the same sum, a small part of the work.
        """
        weight, bias = self.first.weight, self.first.bias
        num_joints, batch, group_size, _ = grouped.shape
        point_weight, pooled_weight, edm_weight = weight.split(
            [self.num_local, pooled.shape[-1], weight.shape[-1] - self.num_local - pooled.shape[-1]], -1
        )
        shared = pooled @ pooled_weight.mT + bias[:, None]  # (K, B, C')
        if self.edm:
            rows = distance_matrix(initial_joints).transpose(0, 1)  # (K, B, K)
            shared = torch.baddbmm(shared, rows, edm_weight.mT)
        hidden = torch.bmm(grouped.reshape(num_joints, batch * group_size, -1), point_weight.mT)
        hidden = hidden.unflatten(1, (batch, group_size)) + shared[:, :, None]
        return self.first_activation(hidden).flatten(1, 2)
