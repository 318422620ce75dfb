"""The Cascaded Pyramid Network (Chen et al. 2018, section 4.3.1): 2D joints in a picture of one person.

A backbone's features go through GlobalNet, a pyramid with heatmaps at each level, and RefineNet, which joins the levels
and makes the heatmaps that count.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ljn.body.skeleton import MIRROR, NUM_JOINTS
from ljn.geometry.heatmaps import decode_heatmaps
from ljn.nets.resnet import STRIDE, Bottleneck, ResNet

SEES = {"rgb": ("rgb", "rgb_camera"), "depth": ("crop", "crop_camera")}
"""What the network can look at, and what of an observation that is."""
_UNIT_M = 0.5  # of depth beside the body's mean
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of colours: ImageNet's, for its weights


class FoundKeypoints(NamedTuple):
    """Keypoints in a crop.

    Attributes:
        keypoints: `(B, 24, 2)`, pixels of the crop.
        confidences: `(B, 24)`, the heights of the heatmaps' peaks, from 0 to 1.
    """

    keypoints: Tensor
    confidences: Tensor


class CascadedPyramidNetwork(nn.Module):
    """The network.

    Args:
        backbone: Makes the features; of as many channels as it `sees`: three of `rgb`, two of `depth`.
        sees: `rgb` or `depth` (the crop about the body's mean, and its mask).
        channels: Of the pyramid.
        refine_width: Of RefineNet's bottlenecks.
        flip_test: Whether, outside of training, the picture and its mirror image are both looked at.
        decoding: See `decode_heatmaps`.

    Raises:
        ValueError: It sees something else, or the backbone does.
    """

    def __init__(
        self,
        backbone: ResNet,
        sees: str = "rgb",
        channels: int = 256,
        refine_width: int = 128,
        flip_test: bool = True,
        decoding: str = "quarter",
    ) -> None:
        super().__init__()
        if sees not in SEES:
            raise ValueError(f"sees: expected one of {', '.join(SEES)}, got '{sees}'")
        needed = 3 if sees == "rgb" else 2
        if backbone.conv1.in_channels != needed:
            raise ValueError(
                f"backbone: expected {needed} channels in, of a network that sees {sees}, got "
                f"{backbone.conv1.in_channels}; set model.backbone.in_channels={needed}"
            )
        self.sees, self.flip_test, self.decoding = sees, flip_test, decoding
        self.takes = SEES[sees]
        self.backbone = backbone
        self.lateral = nn.ModuleList(
            nn.Sequential(nn.Conv2d(fan_in, channels, 1, bias=False), nn.BatchNorm2d(channels), nn.ReLU())
            for fan_in in backbone.out_channels
        )
        self.upward = nn.ModuleList(
            nn.Sequential(nn.Conv2d(channels, channels, 1, bias=False), nn.BatchNorm2d(channels))
            for _ in range(3)
        )
        self.heads = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(channels, channels, 1, bias=False),
                nn.BatchNorm2d(channels),
                nn.ReLU(),
                nn.Conv2d(channels, NUM_JOINTS, 3, 1, 1),
            )
            for _ in range(4)
        )
        self.refine = nn.ModuleList(
            nn.Sequential(*(Bottleneck(channels, refine_width, 1, channels) for _ in range(level)))
            for level in range(4)
        )
        self.last = nn.Sequential(
            Bottleneck(4 * channels, refine_width, 1, channels), nn.Conv2d(channels, NUM_JOINTS, 3, 1, 1)
        )
        for module in (*self.heads, self.last):
            final: nn.Conv2d = module[-1]
            nn.init.normal_(final.weight, std=0.001)
            nn.init.zeros_(final.bias)  # type: ignore[arg-type]

    def forward(self, image: Tensor, camera: Tensor | None = None) -> FoundKeypoints:
        """The 24 joints in crops.

        Args:
            image: What it `sees`: `(B, 3, H, W)` uint8 colours, or `(B, P, P)` depth, metres, 0 outside the body; sides
                multiples of 32.
            camera: `(B, 4)` of the crops; not looked at.
        """
        image = self.normalised(image)
        heatmaps = self.heatmaps(image)[-1]
        if self.flip_test and not self.training:
            mirrored = self.heatmaps(image.flip(-1))[-1]
            heatmaps = (heatmaps + mirrored.flip(-1)[:, list(MIRROR)]) / 2
        return FoundKeypoints(*decode_heatmaps(heatmaps, STRIDE, self.decoding))

    def normalised(self, image: Tensor) -> Tensor:
        """An image, as in `forward`, as the backbone takes it: `(B, C, H, W)`."""
        if self.sees == "rgb":
            mean, std = (torch.tensor(values, device=image.device)[:, None, None] for values in (_MEAN, _STD))
            x = (image / 255 - mean) / std
        else:
            mask = (image > 0).to(image.dtype)
            mean = (image * mask).sum((1, 2), keepdim=True) / mask.sum((1, 2), keepdim=True).clamp(min=1)
            x = torch.stack([((image - mean) / _UNIT_M).clamp(-2, 2) * mask, mask], 1)
        return x.contiguous(memory_format=torch.channels_last)

    def heatmaps(self, image: Tensor) -> list[Tensor]:
        """GlobalNet's heatmaps from the coarsest level to the finest, then RefineNet's.

        Args:
            image: As `normalised` gives it.

        Returns:
            Five of `(B, 24, H / 4, W / 4)`.
        """
        features = self.backbone(image)
        size = features[0].shape[-2:]
        pyramid: list[Tensor] = []  # from the coarsest level to the finest
        maps = []
        for level in range(3, -1, -1):
            x = self.lateral[level](features[level])
            if pyramid:
                x = x + self.upward[level](_resized(pyramid[-1], x.shape[-2:]))
            pyramid.append(x)
            maps.append(_resized(self.heads[level](x), size))
        # The coarser a level, the more bottlenecks it goes through.
        refined = [_resized(self.refine[level](x), size) for level, x in zip(range(3, -1, -1), pyramid)]
        return [*maps, self.last(torch.cat(refined, 1))]


def _resized(x: Tensor, size: "torch.Size | tuple[int, ...]") -> Tensor:
    return (
        x
        if x.shape[-2:] == size
        else functional.interpolate(x, tuple(size), mode="bilinear", align_corners=False)
    )
