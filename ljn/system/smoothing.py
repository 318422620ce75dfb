"""Smoothing over time: the One Euro filter (Casiez et al. 2012) of positions and of rotations.

A low-pass filter whose cutoff rises with the speed: little jitter where one stands still, little lag where one moves.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat


@dataclass(frozen=True)
class SmoothingSettings:
    """How much is smoothed.

    Attributes:
        joint_cutoff_hz: Cutoff of the joints' positions at rest, hertz; lower is smoother.
        joint_beta: How much it rises with the speed, hertz for each metre a second.
        rotation_cutoff_hz: Cutoff of the rotations at rest, hertz.
        rotation_beta: How much it rises, hertz for each radian a second.
        shape_cutoff_hz: Cutoff of the shape, which does not move; at first it is the mean of what there is.
    """

    joint_cutoff_hz: float = 3.0
    joint_beta: float = 25.0
    rotation_cutoff_hz: float = 4.0
    rotation_beta: float = 6.0
    shape_cutoff_hz: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least = 0.0 if name.endswith("beta") else 1e-6
            if not (isinstance(value, int | float) and math.isfinite(value) and value >= least):
                raise ValueError(f"{name}: expected a number of {least:g} or more, got {value!r}")


_SPEED_CUTOFF_HZ = 1.0  # of the speeds themselves, as the authors take it


class OneEuro:
    """The filter of values that are vectors: each by its own speed.

    Args:
        cutoff_hz: At rest.
        beta: Hertz for each unit of speed.
    """

    def __init__(self, cutoff_hz: float, beta: float) -> None:
        self.cutoff_hz, self.beta = cutoff_hz, beta
        self.value: Tensor | None = None
        self.velocity: Tensor | None = None

    def __call__(self, value: Tensor, seconds: float) -> Tensor:
        """The smoothed value.

        Args:
            value: `(..., D)`, vectors.
            seconds: Since the value before; of the first, of no account.
        """
        if self.value is None or self.velocity is None:
            self.value, self.velocity = value, torch.zeros_like(value)
            return value
        change = self._change(self.value, value)
        share = _share(_SPEED_CUTOFF_HZ, seconds)
        self.velocity = self.velocity + share * (change / seconds - self.velocity)
        speed = self.velocity.norm(dim=-1, keepdim=True)
        self.value = self._moved(self.value, _share(self.cutoff_hz + self.beta * speed, seconds) * change)
        return self.value

    def _change(self, before: Tensor, after: Tensor) -> Tensor:
        return after - before

    def _moved(self, value: Tensor, change: Tensor) -> Tensor:
        return value + change


class OneEuroRotation(OneEuro):
    """The filter of rotation matrices `(..., 3, 3)`, in the tangent space at the smoothed one; see `OneEuro`."""

    def __call__(self, value: Tensor, seconds: float) -> Tensor:
        """See `OneEuro`."""
        if self.value is None:
            self.value, self.velocity = value, torch.zeros_like(value[..., 0])
            return value
        return super().__call__(value, seconds)

    def _change(self, before: Tensor, after: Tensor) -> Tensor:
        return rotmat_to_rotvec(before.mT @ after)

    def _moved(self, value: Tensor, change: Tensor) -> Tensor:
        return value @ rotvec_to_rotmat(change)


class SlowMean(OneEuro):
    """The filter of what hardly changes: the mean of all values, until the cutoff makes it forget the first ones."""

    def __call__(self, value: Tensor, seconds: float) -> Tensor:
        """See `OneEuro`."""
        if self.value is None or self.velocity is None:
            self.value, self.velocity = value, torch.ones(())  # how many values there were
            return value
        self.velocity = self.velocity + 1
        share = max(_share(self.cutoff_hz, seconds), 1 / float(self.velocity))
        self.value = self.value + share * (value - self.value)
        return self.value


def _share(cutoff_hz: Any, seconds: float) -> Any:
    """How much of a change passes: 1 / (1 + tau / dt)."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff_hz * seconds))


class PoseSmoother:
    """Smooths one person's joints, rotations and shape from frame to frame.

    Args:
        settings: See `SmoothingSettings`.
    """

    def __init__(self, settings: SmoothingSettings) -> None:
        self.settings = settings
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after a gap."""
        of = self.settings
        self._filters: dict[str, OneEuro] = {
            "joints": OneEuro(of.joint_cutoff_hz, of.joint_beta),
            "root": OneEuro(of.joint_cutoff_hz, of.joint_beta),
            "rotmats": OneEuroRotation(of.rotation_cutoff_hz, of.rotation_beta),
            "betas": SlowMean(of.shape_cutoff_hz, 0.0),
        }

    def __call__(self, values: dict[str, Tensor], seconds: float) -> dict[str, Tensor]:
        """What is smoothed of a frame.

        Args:
            values: Some of `joints` `(24, 3)`, metres; `root` `(3,)`, metres; `rotmats` `(24, 3, 3)`; `betas` `(10,)`.
            seconds: Since the frame before.

        Raises:
            ValueError: No time has passed.
        """
        if not seconds > 0:
            raise ValueError(f"seconds: expected more than 0 between two frames, got {seconds}")
        return {name: self._filters[name](value, seconds) for name, value in values.items()}

    @property
    def state(self) -> dict[str, Any]:
        """What it remembers, as arrays by name: to go on from."""
        return {
            f"{name}_{part}": getattr(each, part).numpy()
            for name, each in self._filters.items()
            for part in ("value", "velocity")
            if getattr(each, part) is not None
        }

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        self.forget()
        for name, each in self._filters.items():
            for part in ("value", "velocity"):
                if f"{name}_{part}" in state:
                    setattr(each, part, torch.from_numpy(state[f"{name}_{part}"]))
