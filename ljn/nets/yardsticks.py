"""Yardsticks without a network: what the initial joints alone can give.

Both are fitted in closed form from sums over the training samples: `accumulate` batch by batch, then `solve`.
A network that does not beat `Ridge` has learned nothing from the cloud.
"""

from abc import abstractmethod

import torch
from torch import Tensor

from ljn.body.skeleton import NUM_JOINTS
from ljn.nets.detector import CloudDetector, cloud_centre

_SIZE = 3 * NUM_JOINTS


class Yardstick(CloudDetector):
    """Affine regression from the centred initial joints (72) to the joints' offsets (72)."""

    def __init__(self) -> None:
        super().__init__(output="offset")
        self.register_buffer("weight", torch.zeros(_SIZE, _SIZE, dtype=torch.float64))
        self.register_buffer("bias", torch.zeros(_SIZE, dtype=torch.float64))
        self.register_buffer("gram", torch.zeros(_SIZE + 1, _SIZE + 1, dtype=torch.float64))
        self.register_buffer("moment", torch.zeros(_SIZE + 1, _SIZE, dtype=torch.float64))
        self.weight: Tensor
        self.bias: Tensor
        self.gram: Tensor
        self.moment: Tensor

    @torch.no_grad()
    def accumulate(self, points: Tensor, initial_joints: Tensor, joints: Tensor) -> None:
        """Add a batch to the sums: `(B, N, C)`, `(B, 24, 3)`, `(B, 24, 3)`, metres, camera frame."""
        inputs = (initial_joints - cloud_centre(points)).flatten(1).double()
        inputs = torch.cat([inputs, inputs.new_ones(len(inputs), 1)], -1)
        self.gram += inputs.T @ inputs
        self.moment += inputs.T @ (joints - initial_joints).flatten(1).double()

    @abstractmethod
    def solve(self) -> None:
        """Fit the weights to what was accumulated."""

    def regress(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """See `CloudDetector.regress`."""
        offset = initial_joints.flatten(1).double() @ self.weight + self.bias
        return offset.to(initial_joints.dtype).unflatten(-1, (NUM_JOINTS, 3))


class MeanOffset(Yardstick):
    """Each joint moves by its mean offset on the training set."""

    @torch.no_grad()
    def solve(self) -> None:
        """See `Yardstick.solve`."""
        self.bias.copy_(self.moment[-1] / self.gram[-1, -1])


class Ridge(Yardstick):
    """Ridge regression; the bias is not penalised.

    Args:
        penalty: Weight of the squared coefficients, relative to one training sample, m^2.
    """

    def __init__(self, penalty: float = 1e-5) -> None:
        super().__init__()
        self.penalty = penalty

    @torch.no_grad()
    def solve(self) -> None:
        """See `Yardstick.solve`."""
        count = self.gram[-1, -1]
        ridge = torch.full((_SIZE + 1,), self.penalty, dtype=torch.float64, device=self.gram.device)
        ridge[-1] = 0
        solution = torch.linalg.solve(self.gram / count + ridge.diag(), self.moment / count)
        self.weight.copy_(solution[:-1])
        self.bias.copy_(solution[-1])
