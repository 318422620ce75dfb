"""A cascade of per-joint networks on depth patches (ours, beyond the thesis: LJN_jd's idea on a regular grid).

Each pass cuts, from a crop of the depth image, square patches around the joints' present estimates, so wide in space
whatever the distance and the camera, and moves every joint by what it sees there and by what all joints and the whole
crop say. It starts from lifted keypoints, or, joint by joint where there are none, from a first guess of the crop.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from ljn.body.skeleton import NUM_JOINTS
from ljn.geometry.patches import NEAREST_M, SQUARE, patch_squares
from ljn.nets.detector import Detector
from ljn.nets.layers import StackedLinear, initialise

STARTS = ("keypoints", "either")
_UNIT_M = 0.25  # of depth in a patch, relative to the joint; wider patches have a wider one
_STEP_M = 0.3  # of a pass's output
_GUESS_DEPTH_M = 0.5  # of the first guess's depth, about the body's mean


class PatchCascade(Detector):
    """The cascade.

    Args:
        start: `keypoints` (the initial joints) or `either` (those of them that there are, for the others a first guess
            of the crop: keypoints may be missing, some or all).
        patch_sizes_m: Width of each pass's patches at the joint's depth, metres.
        guess_size_m: That of a further pass that a first guess goes through first.
        keypoint_dropout: Share of the training samples that lose keypoints, each keypoint with a probability that is
            uniform between 0 and 1; with `either` alone, where every sample is learned without any, too.
        patch_scales: Every pass looks at patches of these multiples of its width.
        patch_px: Samples along a patch's side, a multiple of 4.
        square_channels: Width of the layer that reads a patch's squares, the same for all joints.
        joint_channels: Widths of each joint's own layers.
        crop_channels: Width of the crop's feature.
        context_channels: Width of the context (all joints, the crop) and of each joint's head.
        encoder_channels: Channels of the crop's encoder, each at half the resolution of the one before.

    Raises:
        ValueError: An unknown start, or a patch that cannot be cut into squares.
    """

    def __init__(
        self,
        start: str = "either",
        patch_sizes_m: Sequence[float] = (0.5, 0.4, 0.32, 0.26),
        guess_size_m: float = 0.8,
        keypoint_dropout: float = 0.3,
        patch_scales: Sequence[float] = (1.0, 2.5),
        patch_px: int = 12,
        square_channels: int = 32,
        joint_channels: Sequence[int] = (96, 64),
        crop_channels: int = 128,
        context_channels: int = 128,
        encoder_channels: Sequence[int] = (16, 32, 64, 64),
    ) -> None:
        super().__init__()
        if start not in STARTS:
            raise ValueError(f"start: expected one of {', '.join(STARTS)}, got '{start}'")
        if patch_px < SQUARE or patch_px % SQUARE:
            raise ValueError(f"patch_px: expected a multiple of {SQUARE}, got {patch_px}")
        if not patch_sizes_m:
            raise ValueError("patch_sizes_m: expected at least one pass, got none")
        if not 0 <= keypoint_dropout <= 1:
            raise ValueError(f"keypoint_dropout: expected a share between 0 and 1, got {keypoint_dropout}")
        self.start = start
        self.keypoint_dropout = keypoint_dropout
        self.takes = ("crop", "crop_camera", "initial_joints", *(("confidences",) * (start == "either")))
        self.encoder = CropEncoder(crop_channels, encoder_channels)

        def patch_pass(size: float) -> PatchPass:
            return PatchPass(
                [size * scale for scale in patch_scales],
                [_UNIT_M if scale == 1 else size * scale / 2 for scale in patch_scales],
                patch_px,
                square_channels,
                joint_channels,
                crop_channels,
                context_channels,
            )

        if start == "either":
            self.guess = nn.Sequential(
                initialise(nn.Linear(crop_channels, 2 * crop_channels)),
                nn.LayerNorm(2 * crop_channels),
                nn.GELU(),
                initialise(nn.Linear(2 * crop_channels, 3 * NUM_JOINTS), scale=0.1),
            )
            self.guess_pass = patch_pass(guess_size_m)
        self.passes = nn.ModuleList(map(patch_pass, patch_sizes_m))

    def forward(
        self, crop: Tensor, crop_camera: Tensor, initial_joints: Tensor, confidences: Tensor | None = None
    ) -> Tensor:
        """Joints `(B, 24, 3)` after the last pass; arguments as in `estimates`."""
        return self.estimates(crop, crop_camera, initial_joints, confidences)[-1]

    def estimates(  # type: ignore[override]
        self, crop: Tensor, crop_camera: Tensor, initial_joints: Tensor, confidences: Tensor | None = None
    ) -> Tensor:
        """Joints after the first guess and its pass, if there are any, and after every other pass.

        No gradient passes from one pass to the one before. In training with `either`, every sample goes through the
        passes twice, without keypoints and with some or all of them: estimates of both are given, in this order.

        Args:
            crop: `(B, P, P)`, depth, metres, 0 outside the body; P a multiple of 2.
            crop_camera: `(B, 4)`: fx, fy, cx, cy of the crop.
            initial_joints: `(B, 24, 3)`, metres, camera frame.
            confidences: `(B, 24)`, 0 where there is no keypoint and the initial joint means nothing; None: all there.

        Returns:
            `(T, B, 24, 3)`, metres, camera frame.
        """
        is_body = crop > 0
        depth = (crop * is_body).sum((1, 2)) / is_body.sum((1, 2)).clamp(min=1)  # (B,), the body's mean
        feature = self.encoder(crop, crop_camera, depth)
        joints = initial_joints
        is_given = torch.ones_like(joints[..., 0]) if confidences is None else (confidences > 0).to(joints)
        estimates = []
        if self.start == "either":
            guess = self.guess(feature).unflatten(-1, (NUM_JOINTS, 3))
            guess = _from_crop(guess, crop_camera, depth, crop.shape[-1])
            found = self.guess_pass(crop, crop_camera, guess.detach(), torch.zeros_like(is_given), feature)
            estimates += [guess, found]
            if self.training:
                is_given = torch.cat([torch.zeros_like(is_given), self._dropped(is_given)])
                crop, crop_camera, feature, joints, found = (
                    torch.cat([part, part]) for part in (crop, crop_camera, feature, joints, found)
                )
            joints = torch.where(is_given[..., None] > 0, joints, found)
        refined = []
        for patch_pass in self.passes:
            joints = patch_pass(crop, crop_camera, joints.detach(), is_given, feature)
            refined.append(joints)
        # (both starts * passes, B, 24, 3) in training, else (passes, B, 24, 3)
        starts = torch.stack(refined).unflatten(1, (-1, len(initial_joints))).transpose(0, 1).flatten(0, 1)
        return torch.cat([torch.stack(estimates), starts]) if estimates else starts

    def _dropped(self, is_given: Tensor) -> Tensor:
        """`(B, 24)` less the keypoints that training takes away."""
        share = torch.rand_like(is_given[:, :1]) * (torch.rand_like(is_given[:, :1]) < self.keypoint_dropout)
        return is_given * (torch.rand_like(is_given) >= share)


class CropEncoder(nn.Module):
    """A small convolutional network on the crop at half its resolution.

    It sees depth, mask, and the slopes of the depth along the image's axes.

    Args:
        out_channels: Width of the feature.
        channels: See `PatchCascade`.
    """

    def __init__(self, out_channels: int, channels: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for fan_in, fan_out in zip((4, *channels), channels):
            kernel = 3 if layers else 5
            layers += [initialise(nn.Conv2d(fan_in, fan_out, kernel, 2, kernel // 2)), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(4), nn.Flatten())
        self.last = nn.Sequential(
            initialise(nn.Linear(16 * channels[-1], out_channels)), nn.LayerNorm(out_channels), nn.GELU()
        )

    def forward(self, crop: Tensor, crop_camera: Tensor, depth: Tensor) -> Tensor:
        """`(B, C)` from a crop, its camera and the body's mean depth `(B,)`."""
        count = _cells((crop > 0).to(crop.dtype))
        is_body = count >= 2
        mean = _cells(crop) / count.clamp(min=1)
        relative = torch.where(is_body, mean - depth[:, None, None], 0.0)
        step = (4 * depth / crop_camera[:, 0])[:, None, None]  # metres from one neighbour to the other
        along_u = torch.where(
            is_body[..., 2:] & is_body[..., :-2], relative[..., 2:] - relative[..., :-2], 0.0
        )
        along_v = torch.where(is_body[:, 2:] & is_body[:, :-2], relative[:, 2:] - relative[:, :-2], 0.0)
        slopes = (
            functional.pad((along_u / step).clamp(-2, 2), (1, 1)),
            functional.pad((along_v / step).clamp(-2, 2), (0, 0, 1, 1)),
        )
        return self.last(self.layers(torch.stack([2 * relative, is_body.to(crop.dtype), *slopes], 1)))


class PatchPass(nn.Module):
    """One pass: moves every joint by what its patches, all joints and the crop's feature say.

    A patch is cut into squares of 4 x 4 samples, and one linear layer, the same for all joints, reads each square at
    all scales; then come the joint's own layers.

    Args:
        sizes_m: Widths of the patches, one a scale, metres.
        units_m: The unit of depth in each, metres.
        patch_px: See `PatchCascade`.
        square_channels: See `PatchCascade`.
        joint_channels: See `PatchCascade`.
        crop_channels: See `PatchCascade`.
        context_channels: See `PatchCascade`.
    """

    def __init__(
        self,
        sizes_m: Sequence[float],
        units_m: Sequence[float],
        patch_px: int,
        square_channels: int,
        joint_channels: Sequence[int],
        crop_channels: int,
        context_channels: int,
    ) -> None:
        super().__init__()
        self.sizes_m, self.units_m, self.patch_px = list(sizes_m), list(units_m), patch_px
        squares = (patch_px // SQUARE) ** 2
        hidden, out = joint_channels
        self.square = initialise(nn.Linear(2 * SQUARE**2 * len(self.sizes_m), square_channels))
        self.joint_in = initialise(StackedLinear(NUM_JOINTS, squares * square_channels, hidden))
        self.joint_norm = nn.LayerNorm(hidden)
        self.joint_out = initialise(StackedLinear(NUM_JOINTS, hidden, out))
        self.context = initialise(nn.Linear(4 * NUM_JOINTS + crop_channels, context_channels))
        self.context_norm = nn.LayerNorm(context_channels)
        self.head_in = initialise(StackedLinear(NUM_JOINTS, out + 1 + context_channels, context_channels))
        self.head_norm = nn.LayerNorm(context_channels)
        self.head_out = initialise(StackedLinear(NUM_JOINTS, context_channels, 3), scale=0.1)

    def forward(
        self, crop: Tensor, crop_camera: Tensor, joints: Tensor, is_given: Tensor, feature: Tensor
    ) -> Tensor:
        """The joints moved.

        Args:
            crop: See `PatchCascade.estimates`.
            crop_camera: See `PatchCascade.estimates`.
            joints: `(B, 24, 3)`, metres, camera frame.
            is_given: `(B, 24)`, 1 where the cascade started from a keypoint, else 0.
            feature: `(B, C)`, of the crop.

        Returns:
            `(B, 24, 3)`.
        """
        x = patch_squares(crop, crop_camera, joints, self.sizes_m, self.units_m, self.patch_px)
        x = functional.relu(self.square(x)).flatten(2).transpose(0, 1)  # (24, B, C)
        x = functional.gelu(self.joint_norm(self.joint_in(x)))
        x = functional.gelu(self.joint_out(x))
        centred = joints - joints.mean(1, keepdim=True)
        context = self.context_norm(self.context(torch.cat([2 * centred.flatten(1), is_given, feature], -1)))
        context = functional.gelu(context).expand(NUM_JOINTS, -1, -1)
        x = torch.cat([x, is_given.T[..., None], context], -1)
        x = self.head_out(functional.gelu(self.head_norm(self.head_in(x))))
        return joints + _STEP_M * x.transpose(0, 1)


def _cells(image: Tensor) -> Tensor:
    """Sums over cells of 2 x 2 pixels: `(B, P, P)` -> `(B, P / 2, P / 2)`."""
    rows = image[:, ::2] + image[:, 1::2]
    return rows[..., ::2] + rows[..., 1::2]


def _from_crop(guess: Tensor, crop_camera: Tensor, depth: Tensor, side: int) -> Tensor:
    """Positions in a crop (-1 to 1 across; depth in half metres about the body's mean) in the camera frame."""
    fx, fy, cx, cy = crop_camera[:, None].unbind(-1)
    z = (_GUESS_DEPTH_M * guess[..., 2] + depth[:, None]).clamp(min=NEAREST_M)
    u, v = ((0.5 * guess[..., axis] + 0.5) * side - 0.5 for axis in (0, 1))
    return torch.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], -1)
