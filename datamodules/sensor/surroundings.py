"""Steps of what is around the person, and of the mask that cuts the person out of it."""

import math
from dataclasses import dataclass

import numpy as np

from datamodules.sensor import kernels
from datamodules.sensor.chain import BORDER_PX, Shot, Step
from datamodules.sensor.measuring import seed_of
from ljn.body.skeleton import JOINT_INDEX

_ENDS = tuple(JOINT_INDEX[f"{side}_{part}"] for side in ("l", "r") for part in ("hand", "foot"))
_HANDS = tuple(JOINT_INDEX[f"{side}_hand"] for side in ("l", "r"))
_FEET = tuple(JOINT_INDEX[f"{side}_foot"] for side in ("l", "r"))
_SHORTEST_Z = 0.2


def _pixel(shot: Shot, point: np.ndarray) -> tuple[float, float]:
    """Where a point `(3,)` is seen."""
    fx, fy, cx, cy = shot.intrinsics
    x, y, z = point
    return fx * x / z + cx, fy * y / z + cy


@dataclass(frozen=True, kw_only=True)
class Occluder(Step):
    """Something before the person, cut away with the background: a box, as furniture, or a rounded shape, as somebody.

    Attributes:
        cover: Range of its area, as a share of the body's box.
    """

    cover: tuple[float, float] = (0.03, 0.25)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        height, width = shot.box
        area = strength * rng.uniform(*self.cover) * height * width
        aspect = math.exp(rng.uniform(-1.2, 1.2))
        half_u, half_v = math.sqrt(area * aspect) / 2, math.sqrt(area / aspect) / 2
        u, v = BORDER_PX + rng.random(2) * (width, height)
        is_box = bool(rng.random() < 0.5)
        if is_box and rng.random() < 0.5:  # a table: everything from a height down, on one side
            u, v = BORDER_PX + rng.choice([0, width]), BORDER_PX + height
            half_u, half_v = 2 * half_u, 2 * half_v
        angle = 0.1 * rng.standard_normal() if is_box else rng.uniform(0, math.pi)
        kernels.clear_shape(shot.depth, u, v, max(half_u, 0.5), max(half_v, 0.5), angle, is_box)


@dataclass(frozen=True, kw_only=True)
class HeldObject(Step):
    """Something in a hand, taken for a part of the person: a ball, a bag, a stick, a board.

    Attributes:
        size_m: Range of its half width and half height, metres.
    """

    size_m: tuple[float, float] = (0.03, 0.18)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        hand = shot.joints[rng.choice(_HANDS)] + 0.03 * rng.standard_normal(3)
        if hand[2] < _SHORTEST_Z:
            return
        u, v = _pixel(shot, hand)
        px = shot.intrinsics[0] / hand[2]
        half_u, half_v = strength * px * rng.uniform(*self.size_m, 2)
        slopes = rng.uniform(-1, 1, 2) / px
        kernels.add_object(
            *(shot.depth, shot.spans, u, v, max(half_u, 0.5), max(half_v, 0.5), rng.uniform(0, math.pi)),
            *(bool(rng.random() < 0.5), hand[2], rng.uniform(0.01, 0.08), *slopes),
        )


@dataclass(frozen=True, kw_only=True)
class Floor(Step):
    """Floor around the feet, left in the mask.

    Attributes:
        reach_m: Range of its radius around a foot, metres.
    """

    reach_m: tuple[float, float] = (0.05, 0.25)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        lean = 0.25 * rng.standard_normal()
        normal = np.array([0.0, math.cos(lean), math.sin(lean)])
        lowest = max((shot.joints[foot] for foot in _FEET), key=lambda foot: float(foot @ normal))
        if lowest[2] < _SHORTEST_Z:
            return
        offset = float(lowest @ normal) + 0.02
        reach = strength * rng.uniform(*self.reach_m) * shot.intrinsics[0] / lowest[2]
        for foot in _FEET:
            joint = shot.joints[foot]
            if joint[2] >= _SHORTEST_Z and abs(float(joint @ normal) - offset) < 0.12:
                u, v = _pixel(shot, joint)
                kernels.add_plane(
                    shot.depth, shot.spans, shot.intrinsics, normal, offset, u, v, reach, joint[2], 0.4
                )


@dataclass(frozen=True, kw_only=True)
class CutOff(Step):
    """The person stands across the image's edge: a side of the body's box is lost.

    Attributes:
        most: Greatest part of the box's height or width.
    """

    most: float = 0.3

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        part = strength * self.most * rng.random()
        rows, columns = (BORDER_PX + round(part * side) for side in shot.box)
        side = rng.choice(4, p=[0.5, 0.1, 0.2, 0.2])  # feet most often
        if side == 0:
            shot.depth[-rows:] = 0
        elif side == 1:
            shot.depth[:rows] = 0
        elif side == 2:
            shot.depth[:, :columns] = 0
        else:
            shot.depth[:, -columns:] = 0


@dataclass(frozen=True, kw_only=True)
class LostLimb(Step):
    """A mask without a hand or a foot.

    Attributes:
        radius_m: Range of the radius that is lost around the hand's or foot's joint, metres.
    """

    radius_m: tuple[float, float] = (0.08, 0.2)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        x, y, z = map(float, shot.joints[rng.choice(_ENDS)])
        if z >= _SHORTEST_Z:
            kernels.lose_ball(shot.depth, shot.intrinsics, x, y, z, strength * rng.uniform(*self.radius_m))


@dataclass(frozen=True, kw_only=True)
class MaskErrors(Step):
    """A mask that loses some of the body's border, or gains some of what is behind it; up to two pixels.

    Attributes:
        lose: Greatest share of the border's pixels that is lost in one pass.
        gain: Greatest share of the pixels around it that is gained.
        behind_m: Range of the distance of what is behind the body, metres.
    """

    lose: float = 0.6
    gain: float = 0.3
    behind_m: tuple[float, float] = (0.05, 2.0)

    def expose(self, shot: Shot, rng: np.random.Generator, strength: float) -> None:
        """See `Step`."""
        is_loss = rng.random() < 0.6
        for _ in range(rng.integers(1, 3)):
            if is_loss:
                kernels.lose_border(shot.depth, shot.spans, strength * self.lose * rng.random(), seed_of(rng))
            else:
                behind = rng.uniform(*self.behind_m)
                kernels.gain_border(
                    shot.depth, shot.spans, strength * self.gain * rng.random(), behind, seed_of(rng)
                )
