"""The chain: which steps a sample goes through, how strongly, and with which draws."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from datamodules.sensor import kernels
from ljn.body import BodyModel
from ljn.cloud.observation import body_box
from ljn.geometry.camera import Camera

BORDER_PX = 12
"""Room around the body that steps see, for what is added to it."""
_LEAST_LEFT = 0.15
"""Of a body's pixels; where a chain leaves fewer, the image stays as it was."""
_FEWEST_LEFT = 40


class Shot(NamedTuple):
    """A depth image as it is taken: the part of it around the body.

    Attributes:
        depth: `(H, W)` float32, metres, 0 where nothing is measured, or nothing of the person; changed in place.
        spans: `(H, 2)` int64; see `datamodules.sensor.kernels`.
        intrinsics: `(4,)` float64: fx, fy, cx, cy in the pixels of this part.
        joints: `(24, 3)`, true joints, metres, camera frame.
    """

    depth: np.ndarray
    spans: np.ndarray
    intrinsics: np.ndarray
    joints: np.ndarray

    @property
    def box(self) -> tuple[int, int]:
        """Height and width of the body's box, pixels; `BORDER_PX` are around it."""
        height, width = self.depth.shape
        return height - 2 * BORDER_PX, width - 2 * BORDER_PX


@dataclass(frozen=True, kw_only=True)
class Step:
    """Base of the steps. A subclass does one thing, in the one of these methods that it overrides.

    Its fields are numbers; those of two numbers are ranges.

    Attributes:
        share: Share of the samples that go through it; 0 switches it off.
    """

    share: float = 1.0

    def __post_init__(self) -> None:
        name = type(self).__name__
        for field in fields(self):
            value, default = getattr(self, field.name), field.default
            numbers = tuple(value) if isinstance(value, list | tuple) else (value,)
            if not all(isinstance(number, int | float) and math.isfinite(number) for number in numbers):
                raise ValueError(f"{name}.{field.name}: expected a number or numbers, got {value!r}")
            if isinstance(default, tuple) and len(default) == 2:
                if not isinstance(value, list | tuple) or len(value) != 2 or value[0] > value[1]:
                    raise ValueError(
                        f"{name}.{field.name}: expected 2 numbers, lowest and highest, got {value!r}"
                    )
            elif default is not MISSING and isinstance(value, list | tuple) != isinstance(default, tuple):
                expected = "numbers" if isinstance(default, tuple) else "a number"
                raise ValueError(f"{name}.{field.name}: expected {expected}, got {value!r}")
            if isinstance(value, list | tuple):
                object.__setattr__(self, field.name, tuple(map(float, value)))
        if not 0 <= self.share <= 1:
            raise ValueError(f"{name}.share: expected a share between 0 and 1, got {self.share}")

    def turn(self, rng: np.random.Generator, strength: float) -> np.ndarray | None:
        """A rotation `(3, 3)` of the body in the body world, about the camera; None for none."""
        return None

    def shape(self, betas: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
        """Other shape coefficients `(10,)`."""
        return betas

    def dress(self, vertices: np.ndarray, body: BodyModel, rng: np.random.Generator, strength: float) -> None:
        """Change the surface `(V, 3)`, metres, in the camera's axes, in place; joints and the body's place stay."""

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """Change the image, in place."""


@dataclass(frozen=True)
class Sensor:
    """A chain of steps, in their order.

    Each sample and step has draws of its own, which no other step's settings change.

    Attributes:
        steps: The steps by name.
        strength: Of all steps: their sizes are multiplied by it; 0 leaves everything as it is.
        varies: Whether each step of each sample has a strength of its own, uniform from 0 to `strength`.
    """

    base: ClassVar[type[Step]] = Step
    methods: ClassVar[tuple[str, ...]] = ("turn", "shape", "dress", "expose")

    steps: Mapping[str, Step]
    strength: float = 1.0
    varies: bool = False

    def __post_init__(self) -> None:
        if not (isinstance(self.strength, int | float) and 0 <= self.strength < math.inf):
            raise ValueError(f"sensor.strength: expected a number of 0 or more, got {self.strength!r}")
        for name, step in self.steps.items():
            if not isinstance(step, Step):
                raise ValueError(
                    f"sensor.steps.{name}: expected a step of datamodules.sensor, got {type(step).__name__}"
                )

    def turn(self, key: list[int]) -> np.ndarray | None:
        """A rotation `(3, 3)` of the body in the body world; `key` is what the draws depend on."""
        turned: np.ndarray | None = None
        for step, rng, strength in self._drawn(key, "turn"):
            rotation = step.turn(rng, strength)
            if rotation is not None:
                turned = rotation if turned is None else rotation @ turned
        return turned

    def shape(self, betas: np.ndarray, key: list[int]) -> np.ndarray:
        """Shape coefficients `(10,)` in place of others; `key` is what the draws depend on."""
        for step, rng, strength in self._drawn(key, "shape"):
            betas = step.shape(betas, rng, strength)
        return betas

    def dress(self, vertices: np.ndarray, body: BodyModel, key: list[int]) -> None:
        """Change a surface `(V, 3)`, metres, in place; `key` is what the draws depend on."""
        for step, rng, strength in self._drawn(key, "dress"):
            step.dress(vertices, body, rng, strength)

    def expose(self, depth: np.ndarray, camera: Camera, joints: np.ndarray, key: list[int]) -> None:
        """Take a depth image `(H, W)` float32, metres, in place.

        Where less than a seventh of the body would be left, or hardly a pixel, the image stays as it was.

        Args:
            depth: Of the body alone; 0 elsewhere.
            camera: The camera.
            joints: `(24, 3)`, metres, camera frame.
            key: What the draws depend on.
        """
        left, right, top, bottom = body_box(depth)
        if right < left:
            return
        # With a border all around, even beyond the image, where it is forgotten again.
        body = depth[top : bottom + 1, left : right + 1]
        part = np.zeros((body.shape[0] + 2 * BORDER_PX, body.shape[1] + 2 * BORDER_PX), np.float32)
        part[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = body
        spans = np.empty((len(part), 2), np.int64)
        number = kernels.row_spans(part, spans)
        left, top = left - BORDER_PX, top - BORDER_PX
        intrinsics = np.array([camera.fx, camera.fy, camera.cx - left, camera.cy - top])
        shot = Shot(part, spans, intrinsics, np.asarray(joints))
        for step, rng, strength in self._drawn(key, "expose"):
            step.expose(shot, rng, strength)
        if kernels.row_spans(part, spans) >= max(_FEWEST_LEFT, _LEAST_LEFT * number):
            u, v = max(0, left), max(0, top)
            image = depth[v : top + len(part), u : left + part.shape[1]]
            image[:] = part[v - top :, u - left :][: image.shape[0], : image.shape[1]]

    def _drawn(self, key: list[int], method: str) -> Iterator[tuple[Step, np.random.Generator, float]]:
        """The steps that a sample goes through which override `method`, each with its generator and strength."""
        chosen = self._overriding[method]
        if not chosen:
            return
        seeds = np.random.default_rng(key).integers(2**62, size=(len(self.steps), 3))
        for place, step in chosen:
            switch, strength = seeds[place, :2] / 2**62
            if switch < step.share and self.strength > 0:
                rng = np.random.Generator(np.random.PCG64(int(seeds[place, 2])))
                yield step, rng, self.strength * (strength if self.varies else 1.0)

    @cached_property
    def _overriding(self) -> dict[str, list[tuple[int, Step]]]:
        return {
            method: [
                (place, step)
                for place, step in enumerate(self.steps.values())
                if getattr(type(step), method, None) not in (None, getattr(self.base, method))
            ]
            for method in self.methods
        }
