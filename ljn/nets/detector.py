"""What every joint detector shares: the centred frame and the meaning of the output."""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

OUTPUTS = ("offset", "absolute")


def cloud_centre(points: Tensor) -> Tensor:
    """Mean position of the points: `(B, N, C)` -> `(B, 1, 3)`, metres."""
    return points[..., :3].mean(1, keepdim=True)


class Detector(nn.Module, ABC):
    """Base of the joint detectors: an observation in, joints `(B, 24, 3)` out; metres, camera frame.

    Attributes:
        takes: What of an observation it is called with: keys of a batch, in the order of its arguments.
        is_root_relative: Whether only its joints' positions beside the root mean something.
    """

    takes: tuple[str, ...]
    is_root_relative: ClassVar[bool] = False

    def estimates(self, *observation: Tensor) -> Tensor:
        """Joints `(T, B, 24, 3)` after each of T steps, the last one those of a call: all are trained."""
        return self(*observation)[None]


class CloudDetector(Detector):
    """Base of the detectors that take a cloud and initial joints.

    Everything is centred on the cloud's mean first, so a detector does not see where the person stands.
    Subclasses implement `regress` in that frame.

    Args:
        output: `offset`: `regress` gives offsets to the initial joints; `absolute`: positions.
    """

    takes = ("points", "initial_joints")

    def __init__(self, output: str = "offset") -> None:
        super().__init__()
        if output not in OUTPUTS:
            raise ValueError(f"output: expected one of {', '.join(OUTPUTS)}, got '{output}'")
        self.output = output

    def forward(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """Predict the joints.

        Args:
            points: `(B, N, C)`: position (metres, camera frame) and further channels of each point.
            initial_joints: `(B, 24, 3)`, metres, camera frame.

        Returns:
            `(B, 24, 3)`, metres, camera frame.
        """
        centre = cloud_centre(points)
        points = torch.cat([points[..., :3] - centre, points[..., 3:]], -1)
        joints = initial_joints - centre
        prediction = self.regress(points, joints)
        return prediction + (initial_joints if self.output == "offset" else centre)

    @abstractmethod
    def regress(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """`(B, N, C)`, `(B, 24, 3)`, centred -> `(B, 24, 3)`: offsets or positions, as `output` says."""
