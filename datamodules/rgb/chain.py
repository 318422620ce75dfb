"""The chain of steps that make a colour image: bodies, their looks, the picture taken of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from datamodules.rgb.look import Look
from datamodules.sensor.chain import Sensor, Step


@dataclass
class Photo:
    """A crop of a colour image; steps change it.

    Attributes:
        rgb: `(h, w, 3)` float32, 0-1, as a screen shows it (not linear), person and background.
        mask: `(2 h, 2 w)` uint8, twice as fine, 1 on the person.
    """

    rgb: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ColourStep(Step):
    """Base of the steps of colour images. A subclass overrides one of these methods, or one that changes the body."""

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """Change the person's look or the light, in place."""

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """Change the picture or the person's mask, in place."""


@dataclass(frozen=True)
class Photography(Sensor):
    """A chain of steps, in their order, that make a colour image; those of `Sensor` that change the body are welcome.

    Attributes:
        steps: See `Sensor`.
        strength: See `Sensor`.
        varies: See `Sensor`.
    """

    base: ClassVar[type[Step]] = ColourStep
    methods: ClassVar[tuple[str, ...]] = ("turn", "shape", "dress", "style", "photograph")

    steps: Mapping[str, Step]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, step in self.steps.items():
            if type(step).expose is not Step.expose:
                raise ValueError(
                    f"photo.steps.{name}: expected a step of bodies or of colour images (datamodules.rgb), got "
                    f"{type(step).__name__}, one of depth images"
                )

    def style(self, look: Look, key: list[int]) -> None:
        """Change a look, in place; `key` is what the draws depend on."""
        for step, rng, strength in self._drawn(key, "style"):
            step.style(look, rng, strength)  # type: ignore[attr-defined]

    def photograph(self, photo: Photo, key: list[int]) -> None:
        """Change a picture, in place; `key` is what the draws depend on."""
        for step, rng, strength in self._drawn(key, "photograph"):
            step.photograph(photo, rng, strength)  # type: ignore[attr-defined]
