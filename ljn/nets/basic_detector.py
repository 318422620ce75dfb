"""The basic joint detector (section 3.3.2, Fig. 3.5): one PointNet regresses all joints."""

from collections.abc import Sequence

from torch import Tensor

from ljn.body.skeleton import NUM_JOINTS
from ljn.nets.detector import CloudDetector
from ljn.nets.layers import OUTPUT_SCALE, initialise_for_prelu, perceptron
from ljn.nets.pointnet import PointNet


class BasicDetector(CloudDetector):
    """Every point carries the 72 initial coordinates; a PointNet regresses 72 outputs.

    Args:
        in_channels: Channels of a point.
        local_channels: First widths of the shared perceptron.
        global_channels: Its other widths, up to the global feature.
        head_channels: Hidden widths of the head.
        slope: Of the PReLUs' negative sides before training. Near 1, a deep perceptron starts almost linear: what
            the 72 coordinates say, a linear map of which is already a good detector, gets through its layers.
        output: See `CloudDetector`.
    """

    def __init__(
        self,
        in_channels: int = 6,
        local_channels: Sequence[int] = (64, 64),
        global_channels: Sequence[int] = (64, 128, 1024),
        head_channels: Sequence[int] = (512, 256),
        slope: float = 0.8,
        output: str = "offset",
    ) -> None:
        super().__init__(output)
        self.trunk = PointNet(in_channels + 3 * NUM_JOINTS, local_channels, global_channels, slope=slope)
        initialise_for_prelu(self.trunk.local[0], slope, parts=(in_channels, 3 * NUM_JOINTS))
        self.head = perceptron(
            [global_channels[-1], *head_channels, 3 * NUM_JOINTS],
            last_activation=False,
            last_scale=OUTPUT_SCALE,
            slope=slope,
        )

    def regress(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """See `CloudDetector.regress`."""
        features = self.trunk(points, initial_joints.flatten(1))
        return self.head(features.pooled).unflatten(-1, (NUM_JOINTS, 3))
