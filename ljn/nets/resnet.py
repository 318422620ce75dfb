"""A residual network as a backbone (He et al. 2016): a feature map at each of four resolutions."""

from collections.abc import Sequence

from torch import Tensor, nn

BLOCKS = ("basic", "bottleneck")
STRIDE = 4
"""Pixels of a cell of the finest feature map."""


class ResNet(nn.Module):
    """A stem and four groups of residual blocks, without a classifier.

    With its defaults and three channels it is ResNet-50: parameters have the names and shapes of torchvision's, whose
    weights it takes.

    Args:
        in_channels: Of the image.
        block: `basic` (two 3 x 3 convolutions) or `bottleneck` (1 x 1, 3 x 3, 1 x 1).
        depths: Blocks of each group.
        widths: Channels inside each group's blocks; a bottleneck has four times as many outside.
        stem_channels: Channels of the stem.
        stem_px: Side of the stem's kernel, odd.

    Raises:
        ValueError: An unknown block, or other than four groups.
    """

    def __init__(
        self,
        in_channels: int = 3,
        block: str = "bottleneck",
        depths: Sequence[int] = (3, 4, 6, 3),
        widths: Sequence[int] = (64, 128, 256, 512),
        stem_channels: int = 64,
        stem_px: int = 7,
    ) -> None:
        super().__init__()
        if block not in BLOCKS:
            raise ValueError(f"block: expected one of {', '.join(BLOCKS)}, got '{block}'")
        if not len(depths) == len(widths) == 4 or min(depths) < 1:
            raise ValueError(
                f"depths, widths: expected four numbers each, of blocks (one at least) and channels, got "
                f"{list(depths)} and {list(widths)}"
            )
        self.conv1 = nn.Conv2d(in_channels, stem_channels, stem_px, 2, stem_px // 2, bias=False)
        self.bn1 = nn.BatchNorm2d(stem_channels)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        kind = BasicBlock if block == "basic" else Bottleneck
        channels = stem_channels
        self.out_channels: list[int] = []
        for number, (depth, width) in enumerate(zip(depths, widths), start=1):
            blocks: list[nn.Module] = []
            for i in range(depth):
                stride = 2 if number > 1 and i == 0 else 1
                blocks.append(kind(channels, width, stride))
                channels = width * kind.expansion
            self.add_module(f"layer{number}", nn.Sequential(*blocks))
            self.out_channels.append(channels)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
        for layer in self.modules():
            if isinstance(layer, BasicBlock | Bottleneck):
                layer.begin_as_identity()

    def forward(self, image: Tensor) -> list[Tensor]:
        """The feature maps C2 to C5.

        Args:
            image: `(B, C, H, W)`; H and W multiples of 32.

        Returns:
            Four maps `(B, C', H / s, W / s)` for s = 4, 8, 16 and 32, of `out_channels`.
        """
        x = self.maxpool(self.relu(self.bn1(self.conv1(image))))
        features = []
        for number in range(1, 5):
            x = self.get_submodule(f"layer{number}")(x)
            features.append(x)
        return features


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut: `(B, C, H, W)` -> `(B, width, H / stride, W / stride)`.

    Args:
        in_channels: C.
        width: Channels of both convolutions.
        stride: Of the first one.
    """

    expansion = 1

    def __init__(self, in_channels: int, width: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = shortcut(in_channels, width, stride)

    def begin_as_identity(self) -> None:
        """Let the block add nothing at first."""
        nn.init.zeros_(self.bn2.weight)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        out = self.relu(self.bn1(self.conv1(x)))
        out = self.bn2(self.conv2(out))
        return self.relu(out + (x if self.downsample is None else self.downsample(x)))


class Bottleneck(nn.Module):
    """A 3 x 3 convolution between two of 1 x 1 beside a shortcut: `(B, C, H, W)` -> `(B, C', H / stride, W / stride)`.

    Args:
        in_channels: C.
        width: Channels of the 3 x 3 convolution.
        stride: Its stride.
        out_channels: C'; None for four times the width.
    """

    expansion = 4

    def __init__(
        self, in_channels: int, width: int, stride: int = 1, out_channels: int | None = None
    ) -> None:
        super().__init__()
        out_channels = self.expansion * width if out_channels is None else out_channels
        self.conv1 = nn.Conv2d(in_channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out_channels, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out_channels)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = shortcut(in_channels, out_channels, stride)

    def begin_as_identity(self) -> None:
        """Let the block add nothing at first."""
        nn.init.zeros_(self.bn3.weight)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        out = self.relu(self.bn1(self.conv1(x)))
        out = self.relu(self.bn2(self.conv2(out)))
        out = self.bn3(self.conv3(out))
        return self.relu(out + (x if self.downsample is None else self.downsample(x)))


def shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Sequential | None:
    """A 1 x 1 convolution to a block's output's shape; None where the input has it already."""
    if in_channels == out_channels and stride == 1:
        return None
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 1, stride, bias=False), nn.BatchNorm2d(out_channels)
    )
