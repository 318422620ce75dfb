"""LJN_pse (section 3.4, Fig. 3.6-3.9): pose and shape from a cloud and 3D joints, refined in iterations."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from ljn.body import SMPL
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import LEVELS, NUM_JOINTS, PARENTS, ROOT
from ljn.geometry.rotations import BODY_TO_OPENGL, rot6d_to_rotmat, rotvec_to_rotmat
from ljn.nets.layers import OUTPUT_SCALE, StackedLinear, StackedPReLU, perceptron, stacked_perceptron
from ljn.nets.pointnet import PointNet
from ljn.nets.pointnet2 import PointNet2

_MAX_ITERATIONS = 100  # a checkpoint from anywhere may ask for any number

ROTATIONS = {"rotvec": (3, rotvec_to_rotmat), "rot6d": (6, rot6d_to_rotmat)}
"""Forms in which a network holds a joint's rotation: how many numbers, and the way to a matrix."""


class BodyEstimate(NamedTuple):
    """Pose and shape after each iteration, the last one best.

    Attributes:
        rotmats: `(T, B, 24, 3, 3)`, relative to the parent joint; the first maps SMPL's rest frame into body world.
        betas: `(T, B, 10)`.
    """

    rotmats: Tensor
    betas: Tensor


class BodyNetwork(nn.Module, ABC):
    """Base of the mesh regressors' networks: an observation in, a `BodyEstimate` out.

    Attributes:
        takes: What of an observation it is called with: keys of a batch, in the order of its arguments.
    """

    takes: tuple[str, ...]

    def use_body(self, body: SMPL) -> None:
        """Take from the predicted body what the network needs to know of it; most need nothing."""


class CloudBodyNetwork(BodyNetwork):
    """Base of the thesis's networks: an initial estimate from the cloud's global feature, then residuals.

    The root's rotation is held in the axes of R (Eq. 3.5), where a body that faces the camera is not turned at all
    and the cut at a half turn lies behind it.

    Args:
        trunk: A `PointNet2` or a `PointNet` whose points have 6 + 72 channels: each carries the 72 coordinates of the
            initial joints.
        num_iterations: How often the estimate is refined, by the same weights.
        rotation: `rotvec` (axis-angle, the thesis's) or `rot6d`.
        head_channels: Hidden widths of the initial estimate's head.
    """

    takes = ("points", "initial_joints")

    def __init__(
        self,
        trunk: PointNet | PointNet2,
        num_iterations: int = 3,
        rotation: str = "rotvec",
        head_channels: Sequence[int] = (256,),
    ) -> None:
        super().__init__()
        if rotation not in ROTATIONS:
            raise ValueError(f"rotation: expected one of {', '.join(ROTATIONS)}, got '{rotation}'")
        if not 1 <= num_iterations <= _MAX_ITERATIONS:
            raise ValueError(f"num_iterations: expected 1 to {_MAX_ITERATIONS}, got {num_iterations}")
        self.num_iterations = num_iterations
        self.num_angles, self._to_rotmat = ROTATIONS[rotation]
        self.trunk = trunk
        num_outputs = NUM_JOINTS * self.num_angles + NUM_BETAS
        self.head = perceptron(
            [self.trunk.out_channels, *head_channels, num_outputs],
            last_activation=False,
            last_scale=OUTPUT_SCALE,
        )
        identity = [0.0, 0, 0] if rotation == "rotvec" else [1.0, 0, 0, 0, 1, 0]
        self.mean_pose = nn.Parameter(torch.tensor(identity).repeat(NUM_JOINTS, 1))
        self.mean_betas = nn.Parameter(torch.zeros(NUM_BETAS))

    def forward(self, points: Tensor, initial_joints: Tensor) -> BodyEstimate:
        """Estimate pose and shape.

        Args:
            points: `(B, N, 6)`: position (metres, camera frame) and normal of each point.
            initial_joints: `(B, 24, 3)`, metres, camera frame.
        """
        feature = self.feature(points, initial_joints)
        pose, betas = self.head(feature).split([NUM_JOINTS * self.num_angles, NUM_BETAS], -1)
        pose = self.mean_pose + pose.unflatten(-1, (NUM_JOINTS, self.num_angles))
        betas = self.mean_betas + betas
        poses, shapes = zip(*self.refine(feature, pose, betas))
        rotmats = self._to_rotmat(torch.stack(poses))  # (T, B, 24, 3, 3)
        root, others = rotmats.split([1, NUM_JOINTS - 1], 2)
        root = BODY_TO_OPENGL.T.to(root) @ root
        return BodyEstimate(torch.cat([root, others], 2), torch.stack(shapes))

    def feature(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """The cloud's global feature `(B, C)`, all centred on the initial root; arguments as in a call."""
        root = initial_joints[:, ROOT, None]
        joints = (initial_joints - root).flatten(1)  # of every point, hence once a cloud
        return self.trunk.global_feature(torch.cat([points[..., :3] - root, points[..., 3:]], -1), joints)

    @abstractmethod
    def refine(self, feature: Tensor, pose: Tensor, betas: Tensor) -> "list[tuple[Tensor, Tensor]]":
        """The estimates of all iterations, from the feature `(B, C)`, pose `(B, 24, A)` and betas `(B, 10)`."""


class HierarchicalBodyNetwork(CloudBodyNetwork):
    """LJN_pse: joint by joint from the root down, then the shape.

    Regressor i gives a residual to theta_i from theta'_i, the refined theta_j of all ancestors j of joint i, beta'
    and the global feature; then the beta regressor from beta', theta and the feature. Joints of one level of the
    tree have equally many ancestors and are refined at once.

    Args:
        trunk: See `CloudBodyNetwork`.
        num_iterations: See `CloudBodyNetwork`.
        rotation: See `CloudBodyNetwork`.
        head_channels: See `CloudBodyNetwork`.
        regressor_channels: Hidden widths of every regressor.
        passes_ancestors: Whether a regressor sees its ancestors' rotations (off: the ablation "single").
    """

    def __init__(
        self,
        trunk: PointNet | PointNet2,
        num_iterations: int = 3,
        rotation: str = "rotvec",
        head_channels: Sequence[int] = (256,),
        regressor_channels: Sequence[int] = (256, 256),
        passes_ancestors: bool = True,
    ) -> None:
        super().__init__(trunk, num_iterations, rotation, head_channels)
        self.passes_ancestors = passes_ancestors
        size = self.trunk.out_channels
        self.joint_regressors = nn.ModuleList(
            JointRegressors(
                [_ancestors(joint) if passes_ancestors else [] for joint in level],
                size,
                self.num_angles,
                regressor_channels,
            )
            for level in LEVELS
        )
        self.beta_regressor = perceptron(
            [size + NUM_JOINTS * self.num_angles + NUM_BETAS, *regressor_channels, NUM_BETAS],
            last_activation=False,
            last_scale=OUTPUT_SCALE,
        )

    def refine(self, feature: Tensor, pose: Tensor, betas: Tensor) -> list[tuple[Tensor, Tensor]]:
        """See `CloudBodyNetwork.refine`."""
        levels = cast(list[JointRegressors], list(self.joint_regressors))
        shared = [regressors.share(feature) for regressors in levels]
        estimates = []
        for _ in range(self.num_iterations):
            refined = pose[:, :0]
            start = 0
            for regressors, part in zip(levels, shared):
                stop = start + regressors.num_joints
                refined = torch.cat([refined, regressors(pose[:, start:stop], refined, betas, part)], 1)
                start = stop
            pose = refined
            betas = betas + self.beta_regressor(torch.cat([feature, pose.flatten(1), betas], -1))
            estimates.append((pose, betas))
        return estimates


class JointRegressors(nn.Module):
    """The regressors of one level of the tree (Fig. 3.7a).

    Args:
        ancestors: Of each joint of the level, the joints whose refined rotations it sees: equally many.
        feature_channels: Channels of the global feature.
        num_angles: Numbers that hold a rotation, A.
        channels: Hidden widths.
    """

    def __init__(
        self,
        ancestors: Sequence[Sequence[int]],
        feature_channels: int,
        num_angles: int,
        channels: Sequence[int],
    ) -> None:
        super().__init__()
        self.num_joints = len(ancestors)
        self.register_buffer("ancestors", torch.tensor(ancestors, dtype=torch.int64), persistent=False)
        self.ancestors: Tensor
        num_inputs = num_angles * (1 + len(ancestors[0])) + NUM_BETAS
        self.num_inputs = num_inputs
        self.first = StackedLinear(self.num_joints, num_inputs + feature_channels, channels[0])
        self.first_activation = StackedPReLU(self.num_joints)
        self.rest = stacked_perceptron(
            self.num_joints, [*channels, num_angles], last_activation=False, last_scale=OUTPUT_SCALE
        )

    def share(self, feature: Tensor) -> Tensor:
        """The first layer's part that all iterations share: `(B, C)` -> `(k, B, channels[0])`."""
        return feature @ self.first.weight[..., self.num_inputs :].mT + self.first.bias[:, None]

    def forward(self, pose: Tensor, refined: Tensor, betas: Tensor, shared: Tensor) -> Tensor:
        """Refined rotations of the level.

        Args:
            pose: `(B, k, A)`, its joints before.
            refined: `(B, j, A)`, the joints of all higher levels, refined.
            betas: `(B, 10)`.
            shared: See `share`.

        Returns:
            `(B, k, A)`.
        """
        seen = refined[:, self.ancestors].flatten(2)  # (B, k, ancestors * A)
        inputs = torch.cat([pose, seen, betas[:, None].expand(-1, self.num_joints, -1)], -1)
        hidden = torch.baddbmm(shared, inputs.transpose(0, 1), self.first.weight[..., : self.num_inputs].mT)
        return pose + self.rest(self.first_activation(hidden)).transpose(0, 1)


class DirectBodyNetwork(CloudBodyNetwork):
    """The basic model (section 3.4.2, Fig. 3.9): one perceptron regresses all residuals of an iteration.

    Args:
        trunk: See `CloudBodyNetwork`.
        num_iterations: See `CloudBodyNetwork`.
        rotation: See `CloudBodyNetwork`.
        head_channels: See `CloudBodyNetwork`.
        regressor_channels: Hidden widths of the regressor.
    """

    def __init__(
        self,
        trunk: PointNet | PointNet2,
        num_iterations: int = 3,
        rotation: str = "rotvec",
        head_channels: Sequence[int] = (256,),
        regressor_channels: Sequence[int] = (1024, 1024),
    ) -> None:
        super().__init__(trunk, num_iterations, rotation, head_channels)
        num_values = NUM_JOINTS * self.num_angles + NUM_BETAS
        self.regressor = perceptron(
            [self.trunk.out_channels + num_values, *regressor_channels, num_values],
            last_activation=False,
            last_scale=OUTPUT_SCALE,
        )

    def refine(self, feature: Tensor, pose: Tensor, betas: Tensor) -> list[tuple[Tensor, Tensor]]:
        """See `CloudBodyNetwork.refine`."""
        estimates = []
        for _ in range(self.num_iterations):
            residual = self.regressor(torch.cat([feature, pose.flatten(1), betas], -1))
            pose = pose + residual[:, :-NUM_BETAS].unflatten(-1, pose.shape[1:])
            betas = betas + residual[:, -NUM_BETAS:]
            estimates.append((pose, betas))
        return estimates


def _ancestors(joint: int) -> list[int]:
    """All joints on the way from a joint's parent up to the root."""
    ancestors = []
    while (joint := PARENTS[joint]) >= 0:
        ancestors.append(joint)
    return ancestors
