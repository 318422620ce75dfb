"""Layers shared by the networks: point-wise perceptrons, alone and stacked over the joints."""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from ljn.geometry.points import gather_points

LayerT = TypeVar("LayerT", bound=Any)


PRELU_SLOPE = 0.25
"""Slope of a PReLU's negative side before training."""
OUTPUT_SCALE = 0.1
"""Of the weights of last layers (see `initialise`): outputs begin near zero, offsets near none."""


def perceptron(
    channels: Sequence[int],
    last_activation: bool = True,
    last_scale: float = 1.0,
    slope: float = PRELU_SLOPE,
) -> nn.Sequential:
    """Linear layers with a PReLU after each (after the last one on request), conditioned by `initialise_for_prelu`.

    Applied to `(..., channels[0])`; on a cloud `(B, N, C)` it is PointNet's shared MLP. No batch
    normalisation: batches are small (section 3.6.1).
    """
    layers: list[nn.Module] = []
    for number, (fan_in, fan_out) in enumerate(pairwise(channels), start=1):
        scale = last_scale if number == len(channels) - 1 else 1.0
        layers.append(initialise_for_prelu(nn.Linear(fan_in, fan_out), slope, scale))
        if last_activation or number < len(channels) - 1:
            layers.append(nn.PReLU(init=slope))
    return nn.Sequential(*layers)


def initialise(layer: LayerT, slope: float = 0.0, scale: float = 1.0, fan_in: int | None = None) -> LayerT:
    """Kaiming's initialisation: what comes out is as large as what went in, after a (leaky) ReLU of `slope`.

    Args:
        layer: With `weight` `(out, in)`, `(K, out, in)` or `(out, in, kh, kw)`, and `bias`, which becomes zero where
            there is one.
        slope: Of the activation on its negative side; 0 for ReLU and GELU.
        scale: Factor of the weights; a small one for last layers, which then start near their bias.
        fan_in: Input channels, where the layer is a part of one that has more.

    Returns:
        The layer.
    """
    if fan_in is None:
        fan_in = layer.weight[0].numel() if layer.weight.ndim == 4 else layer.weight.shape[-1]
    nn.init.normal_(layer.weight, 0.0, scale * math.sqrt(2 / (1 + slope**2) / fan_in))
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


@torch.no_grad()
def initialise_for_prelu(
    layer: LayerT, slope: float = PRELU_SLOPE, scale: float = 1.0, parts: Sequence[int] = ()
) -> LayerT:
    """Kaiming's sizes for a PReLU, with orthogonal rows or columns.

    Gaussian weights, layer after layer, squeeze all but a few directions of the input; orthogonal ones keep
    what 72 coordinates say apart through a deep perceptron.

    Args:
        layer: With `weight` `(out, in)` or `(K, out, in)`, and `bias`, which becomes zero.
        slope: See `initialise`.
        scale: See `initialise`.
        parts: Channels of each part of the input, where it has several: each has the same say at first. A
            point's three coordinates would count for nothing beside hundreds of channels of a global feature.

    Returns:
        The layer.
    """
    parts = list(parts) or [layer.weight.shape[-1]]
    gain = scale * math.sqrt(2 / (1 + slope**2) / len(parts))
    for weight in layer.weight.view(-1, *layer.weight.shape[-2:]):
        fan_out = len(weight)
        for part in weight.split(parts, -1):
            part.copy_(
                nn.init.orthogonal_(torch.empty_like(part), gain * max(1.0, fan_out / part.shape[-1]) ** 0.5)
            )
    nn.init.zeros_(layer.bias)
    return layer


def apply_shared(layers: Iterable[nn.Module], points: Tensor, shared: Tensor | None) -> Tensor:
    """`layers` on points whose last channels are the same all over a cloud: multiplied once a cloud, not once a point.

    Args:
        layers: The first one linear, of `C + S` input channels.
        points: `(B, N, C)`.
        shared: `(B, S)`; None where S is 0.

    Returns:
        What comes of `[points, shared]`, up to rounding: `(B, N, C')`.
    """
    first, *rest = layers
    if shared is None:
        hidden = first(points)
    else:
        linear = cast(nn.Linear, first)
        of_points, of_shared = linear.weight.split([points.shape[-1], shared.shape[-1]], -1)
        hidden = points @ of_points.mT + functional.linear(shared, of_shared, linear.bias)[:, None]
    for layer in rest:
        hidden = layer(hidden)
    return hidden


class StackedLinear(nn.Module):
    """One linear layer for each joint, run as one batched product, conditioned by `initialise_for_prelu`.

    Args:
        num_joints: K.
        fan_in: Input channels.
        fan_out: Output channels.
    """

    def __init__(self, num_joints: int, fan_in: int, fan_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_joints, fan_out, fan_in))
        self.bias = nn.Parameter(torch.empty(num_joints, fan_out))
        initialise_for_prelu(self)

    def forward(self, x: Tensor) -> Tensor:
        """`(K, M, fan_in)` -> `(K, M, fan_out)`."""
        return torch.baddbmm(self.bias[:, None], x, self.weight.mT)


class StackedPReLU(nn.Module):
    """One PReLU slope for each joint."""

    def __init__(self, num_joints: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.full((num_joints,), PRELU_SLOPE))

    def forward(self, x: Tensor) -> Tensor:
        """`(K, ...)` -> `(K, ...)`."""
        return functional.prelu(x.reshape(1, len(x), -1), self.weight).view(x.shape)


def stacked_perceptron(
    num_joints: int, channels: Sequence[int], last_activation: bool = True, last_scale: float = 1.0
) -> nn.Sequential:
    """`perceptron` for each joint: `(K, M, channels[0])` -> `(K, M, channels[-1])`."""
    layers: list[nn.Module] = []
    for number, (fan_in, fan_out) in enumerate(pairwise(channels), start=1):
        scale = last_scale if number == len(channels) - 1 else 1.0
        layers.append(initialise_for_prelu(StackedLinear(num_joints, fan_in, fan_out), scale=scale))
        if last_activation or number < len(channels) - 1:
            layers.append(StackedPReLU(num_joints))
    return nn.Sequential(*layers)


def activate_and_pool(x: Tensor, activation: nn.PReLU | StackedPReLU, dim: int) -> Tensor:
    """`activation(x).amax(dim)`, activated after pooling: the same values and a fraction of the work.

    A PReLU is monotone, or with a negative slope V-shaped: its maximum over a set lies at the set's maximum or
    minimum. `dim` must not be the joints' dimension of a `StackedPReLU`.
    """
    # max with indices: unlike amax, its gradient needs no pass over all of x to find ties.
    pooled = activation(x.max(dim).values)
    if bool((activation.weight < 0).any()):
        pooled = torch.maximum(pooled, activation(x.min(dim).values))
    return pooled


def perceive_and_pool(
    mlp: nn.Sequential, activation: nn.PReLU, points: Tensor, shared: Tensor | None = None
) -> Tensor:
    """`activate_and_pool(mlp(points), activation, 1)`, gradients passing through few points alone.

    A channel's maximum is one point's value; the other points' gradients are zero. A first pass without gradients
    finds one point for each of C channels, and a second one goes through these: a half of the work where there
    are many more points.

    Args:
        mlp: A `perceptron` without its last activation.
        activation: The last activation.
        points: `(B, N, C_in)`; without the last channels where these are `shared`.
        shared: See `apply_shared`.

    Returns:
        `(B, C)`.
    """
    layers: list[Any] = list(mlp)
    *inner, last = layers
    is_trained = torch.is_grad_enabled() and (points.requires_grad or last.weight.requires_grad)
    is_dense = not inner or not is_trained or 2 * last.out_features > points.shape[1]
    if is_dense or bool((activation.weight < 0).any()):
        return activate_and_pool(apply_shared(mlp, points, shared), activation, 1)
    with torch.no_grad():
        index = apply_shared(mlp, points, shared).argmax(1)  # (B, C)
    hidden = apply_shared(
        inner, gather_points(points, index), shared
    )  # (B, C, C_hidden): row c for channel c
    return activation((hidden * last.weight).sum(-1) + last.bias)
