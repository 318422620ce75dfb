"""The simple baseline (Martinez et al. 2017): 2D joints in, root-relative 3D joints out, no cloud."""

import torch
from torch import Tensor, nn

from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.nets.detector import Detector
from ljn.nets.layers import OUTPUT_SCALE, initialise


class SimpleBaseline(Detector):
    """A residual network from the 2D keypoints to 3D joints relative to the root.

    It sees the initial joints' rays alone, (x / z, y / z), which are the keypoints in normalised image coordinates;
    neither their depths nor the cloud. Its joints stand around the initial root, which stays where it is, so only its
    root-aligned errors mean something. Unlike the thesis's networks it has batch normalisation and dropout; the
    weights' max-norm of the original is left out.

    Args:
        channels: Width of the hidden layers.
        num_blocks: Residual blocks of two layers each.
        dropout: Share of the hidden values that are dropped in training.
    """

    takes = ("initial_joints",)
    is_root_relative = True

    def __init__(self, channels: int = 1024, num_blocks: int = 2, dropout: float = 0.5) -> None:
        super().__init__()

        def layer(fan_in: int) -> list[nn.Module]:
            linear = initialise(nn.Linear(fan_in, channels))
            return [linear, nn.BatchNorm1d(channels), nn.ReLU(), nn.Dropout(dropout)]

        self.first = nn.Sequential(*layer(2 * NUM_JOINTS))
        self.blocks = nn.ModuleList(
            nn.Sequential(*layer(channels), *layer(channels)) for _ in range(num_blocks)
        )
        self.last = initialise(nn.Linear(channels, 3 * (NUM_JOINTS - 1)), scale=OUTPUT_SCALE)

    def forward(self, initial_joints: Tensor) -> Tensor:
        """Joints from initial joints, both `(B, 24, 3)`, metres, camera frame; the root stays where it is."""
        rays = initial_joints[..., :2] / initial_joints[..., 2:]
        # The root's ray itself, the others relative to it.
        rays = torch.cat([rays[:, :1], rays[:, 1:] - rays[:, :1]], 1)
        hidden = self.first(rays.flatten(1))
        for block in self.blocks:
            hidden = hidden + block(hidden)
        root = initial_joints[:, ROOT, None]
        return torch.cat([root, self.last(hidden).unflatten(-1, (NUM_JOINTS - 1, 3)) + root], 1)
