"""Steps that a depth camera adds: noise, holes, ragged edges, the steps of its disparity, its range."""

import math
from dataclasses import dataclass

import numpy as np

from datamodules.sensor import kernels
from datamodules.sensor.chain import BORDER_PX, Shot, Step


def seed_of(rng: np.random.Generator) -> np.uint64:
    """A seed for the kernels."""
    return np.uint64(rng.integers(2**62))


@dataclass(frozen=True, kw_only=True)
class AxialNoise(Step):
    """Noise along the optical axis that grows with depth z and with the angle theta between normal and ray.

    Its standard deviation is `c0 + c1 z + c2 z^2 + c3 z^p theta^2 / (pi / 2 - theta)^2`, in metres and radians:

    - Kinect v2, indoors (Fankhauser et al., Kinect v2 for mobile robot navigation, ICAR 2015): 1.5 mm - 0.5 mm z +
      0.3 mm z^2 + 0.1 mm z^1.5 theta^2 / (pi / 2 - theta)^2; the defaults.
    - Kinect v1 (Nguyen et al., Modeling Kinect sensor noise, 3DIMPVT 2012): 1.2 mm + 1.9 mm (z - 0.4)^2 + 0.1 mm
      z^-0.5 theta^2 / (pi / 2 - theta)^2.

    Attributes:
        terms: c0, c1, c2, c3 and p, a multiple of a half.
    """

    terms: tuple[float, ...] = (0.0015, -0.0005, 0.0003, 0.0001, 1.5)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.terms) != 5 or 2 * self.terms[4] % 1:
            raise ValueError(
                f"AxialNoise.terms: expected 5 numbers, c0 to c3 and p, a multiple of 0.5, got {self.terms}"
            )

    def sigma_m(self, z: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The standard deviation at depths, metres, and angles, radians."""
        c0, c1, c2, c3, power = self.terms
        theta = np.minimum(theta, kernels.STEEPEST)
        return c0 + c1 * z + c2 * z**2 + c3 * z**power * theta**2 / (np.pi / 2 - theta) ** 2

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        fx, fy, *_ = shot.intrinsics
        terms, halves = np.array(self.terms[:4]), int(2 * self.terms[4])
        kernels.axial_noise(shot.depth, shot.spans, fx, fy, terms, halves, strength, seed_of(rng))


@dataclass(frozen=True, kw_only=True)
class Lateral(Step):
    """Depth of a pixel measured beside it: edges become ragged, on both sides.

    Attributes:
        sigma_px: Standard deviation of the displacement along u and v, pixels.
    """

    sigma_px: float = 0.6

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        kernels.lateral(shot.depth, shot.spans, strength * self.sigma_px, seed_of(rng))


@dataclass(frozen=True, kw_only=True)
class FlyingPixels(Step):
    """Pixels at a jump of depth that lie between its two surfaces, or between the body and what is behind it.

    Attributes:
        rate: Share of the pixels beside a jump.
        jump_m: Least jump, metres.
        behind_m: Range of the distance of what is behind the body.
    """

    rate: float = 0.25
    jump_m: float = 0.08
    behind_m: tuple[float, float] = (0.1, 1.0)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        rate = min(1.0, strength * self.rate)
        kernels.flying_pixels(
            shot.depth, shot.spans, self.jump_m, rate, rng.uniform(*self.behind_m), seed_of(rng)
        )


@dataclass(frozen=True, kw_only=True)
class Grazing(Step):
    """Surfaces seen at a grazing angle are lost in part.

    Attributes:
        angle_deg: Between normal and ray, degrees.
        rate: Share of their pixels that is lost.
    """

    angle_deg: float = 75
    rate: float = 0.7

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        fx, fy, *_ = shot.intrinsics
        tangent = math.tan(math.radians(self.angle_deg))
        rate = min(1.0, strength * self.rate)
        kernels.grazing(shot.depth, shot.spans, fx, fy, tangent, rate, seed_of(rng))


@dataclass(frozen=True, kw_only=True)
class Multipath(Step):
    """Light that has come by a detour: surfaces seem farther, by a smooth field; and a scale that is a little off.

    Attributes:
        most_m: Of the field, metres.
        scale: Standard deviation of the scale.
    """

    most_m: float = 0.02
    scale: float = 0.003

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        grid = strength * self.most_m * rng.random((5, 5)) * rng.random()
        scale = 1 + strength * self.scale * rng.standard_normal()
        kernels.smooth_bias(shot.depth, shot.spans, scale, grid)


@dataclass(frozen=True, kw_only=True)
class Disparity(Step):
    """Depth in steps, as structured light and stereo measure it: disparity f b / z is read in steps.

    A Kinect v1 or Xtion (580 px at 640 pixels, 75 mm, steps of 1/8 px) has steps of 26 mm at 3 m.

    Attributes:
        focal_baseline: Range of f b, pixels times metres; uniform in its logarithm.
        step_px: Step of the disparity, pixels.
        noise_px: Standard deviation of the disparity's noise.
    """

    focal_baseline: tuple[float, float] = (43.5, 43.5)
    step_px: float = 0.125
    noise_px: float = 0.05

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        low, high = self.focal_baseline
        focal_baseline = math.exp(rng.uniform(math.log(low), math.log(high)))
        if strength > 0:
            kernels.disparity(
                shot.depth, shot.spans, focal_baseline / strength, self.step_px, self.noise_px, seed_of(rng)
            )


@dataclass(frozen=True, kw_only=True)
class Shadow(Step):
    """What a limb hides from the projector, beside it in the image, is lost.

    Attributes:
        baseline_m: From the camera to the projector, metres; to either side.
    """

    baseline_m: float = 0.075

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        is_right = bool(rng.random() < 0.5)
        kernels.shadow(shot.depth, shot.spans, strength * self.baseline_m * shot.intrinsics[0], is_right)


@dataclass(frozen=True, kw_only=True)
class Holes(Step):
    """Places without depth: dark or shining cloth, hair.

    Attributes:
        most: Greatest number of them.
        size: Range of their half width, as a share of the body's longer side in the image.
    """

    most: float = 6
    size: tuple[float, float] = (0.01, 0.05)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        height, width = shot.box
        for _ in range(rng.integers(0, int(self.most) + 1)):
            u, v = BORDER_PX + rng.random(2) * (width, height)
            half_u, half_v = strength * max(width, height) * rng.uniform(*self.size, 2)
            kernels.clear_shape(
                shot.depth, u, v, max(half_u, 0.5), max(half_v, 0.5), rng.uniform(0, np.pi), False
            )


@dataclass(frozen=True, kw_only=True)
class Range(Step):
    """Nothing is measured nearer or farther.

    Attributes:
        near_m: Metres.
        far_m: Metres.
    """

    near_m: float = 0.5
    far_m: float = 4.5

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        kernels.clip_range(shot.depth, shot.spans, self.near_m, self.far_m)
