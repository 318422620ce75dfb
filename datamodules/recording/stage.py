"""What is behind the person: a green curtain before a wall, on a floor, in the person's own light."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from datamodules.rgb.look import Look
from ljn.geometry.camera import Camera

_CELL_M = 0.005
_WAVES = 24
_OCCLUDED = 0.35
"""Share of the light that does not reach the bottom of a fold."""
_WALL_M = 0.35
"""From the curtain to the wall behind it."""
_WALL, _FLOOR = np.array([0.62, 0.60, 0.55]), np.array([0.30, 0.24, 0.19])
"""Linear RGB."""


@dataclass(frozen=True, kw_only=True)
class Curtain:
    """A curtain of green cloth.

    Attributes:
        colour: As a screen shows it, RGB in 0-1.
        width_m: Beyond it the wall is seen.
        folds_m: Depth of its folds, from top to bottom.
        fold_m: Their mean distance.
        wrinkles_m: Standard deviation of its wrinkles.
        uneven: Standard deviation of the light's strength across it, as a share.
        spill: How much of its colour falls back on the person, as a share of the light.
    """

    colour: tuple[float, float, float] = (0.16, 0.58, 0.24)
    width_m: float = 3.0
    folds_m: float = 0.06
    fold_m: float = 0.22
    wrinkles_m: float = 0.003
    uneven: float = 0.3
    spill: float = 0.35

    def __post_init__(self) -> None:
        if len(self.colour) != 3 or not all(0 <= value <= 1 for value in self.colour):
            raise ValueError(f"curtain.colour: expected three numbers in 0-1 (RGB), got {self.colour!r}")
        object.__setattr__(self, "colour", tuple(map(float, self.colour)))
        for name in ("width_m", "folds_m", "fold_m", "wrinkles_m", "uneven", "spill"):
            value, is_length = getattr(self, name), name in ("width_m", "fold_m")
            if not 0 <= value < math.inf or (is_length and value == 0):
                least = "a length of more than 0" if is_length else "a number of 0 or more"
                raise ValueError(f"curtain.{name}: expected {least}, got {value!r}")

    @property
    def albedo(self) -> np.ndarray:
        """Its colour `(3,)`, linear RGB."""
        return np.array(self.colour) ** 2  # a screen shows the square root of light; see `kernels.composed`

    def shine_on(self, look: Look) -> None:
        """Add the light that it throws back to a person's, in place: it comes from behind, and tints edges."""
        strength = 2 * self.spill * self.albedo
        directions = np.array([[-0.9, 0.0, 0.43], [0.9, 0.0, 0.43], [0.0, -0.8, 0.6]])
        green = np.concatenate([directions, np.tile(strength, (3, 1))], 1)
        look.lights = np.concatenate([look.lights, green]).astype(np.float32)
        look.ambient = (look.ambient + 0.25 * strength).astype(np.float32)


class Stage(NamedTuple):
    """The scene without the person.

    Attributes:
        rgb: `(H, W, 3)` float32, 0-1, as a screen shows it.
        depth: `(H, W)` float32, metres.
        is_floor: `(H, W)` bool.
        is_curtain: `(H, W)` bool.
    """

    rgb: np.ndarray
    depth: np.ndarray
    is_floor: np.ndarray
    is_curtain: np.ndarray


def build_stage(
    camera: Camera,
    curtain: Curtain | None,
    look: Look,
    floor_m: float,
    behind_m: float,
    rng: np.random.Generator,
) -> Stage:
    """A floor, a wall and, before it, a curtain.

    Args:
        camera: Level: its y axis points down.
        curtain: None for the wall alone.
        look: Its lights shine on all of it.
        floor_m: How far the floor is below the camera.
        behind_m: Depth of the curtain's foremost folds; the wall stands behind.
        rng: Draws folds, wrinkles and light.
    """
    cloth = None if curtain is None else _Cloth(curtain, look, floor_m, behind_m, rng)
    tone = 1 + 0.1 * rng.standard_normal((64, 64, 1))
    scene = _Room(cloth, look, floor_m, behind_m + _WALL_M, tone)
    fine = np.maximum(scene.picture(camera, 2)[0], 0)
    height, width = camera.height, camera.width
    linear = fine.reshape(height, 2, width, 2, 3).mean((1, 3))
    _, depth, kind = scene.picture(camera, 1)
    rgb = np.minimum(np.sqrt(linear), 1).astype(np.float32)
    return Stage(rgb, depth.astype(np.float32), kind == 0, kind == 1)


def _irradiance(normals: np.ndarray, look: Look) -> np.ndarray:
    """Light `(..., 3)` on surfaces of normals `(..., 3)`: as `kernels.paint` has it, without highlights."""
    above = (0.5 - 0.5 * normals[..., 1:2]).astype(np.float32)
    light = look.ambient[0] * above + look.ambient[1] * (1 - above)
    for direction, colour in zip(look.lights[:, :3], look.lights[:, 3:]):
        light = light + np.maximum(normals @ direction, 0)[..., None] * colour
    return light


class _Cloth:
    """A curtain's height field and colour on a grid, sampled anywhere.

    Attributes:
        colour: `(h, w, 3)` float32, linear RGB, in its light.
    """

    def __init__(
        self, curtain: Curtain, look: Look, floor_m: float, behind_m: float, rng: np.random.Generator
    ) -> None:
        self.behind_m = behind_m
        self.half_m = curtain.width_m / 2
        self.bottom_m = floor_m - 0.015
        self.top_m = floor_m - 3.0
        x = np.arange(-self.half_m - 0.1, self.half_m + 0.1, _CELL_M, dtype=np.float32)
        y = np.arange(self.top_m, floor_m, _CELL_M, dtype=np.float32)[:, None]
        self._origin = x[0], y[0, 0]
        wander, bend = rng.uniform(0, 2 * np.pi, (2, 4))
        phase = 2 * np.pi * x / curtain.fold_m
        for k in range(4):
            phase = phase + rng.uniform(0.5, 1.2) * np.cos((1.1 + 1.7 * k) * x + wander[k])
            phase = phase + rng.uniform(0.05, 0.3) * np.cos((0.6 + k) * y + 0.8 * k * x + bend[k])
        pleats = (0.5 + 0.5 * np.cos(phase)) ** 0.8
        deep = 0.65 + 0.35 * np.cos(2.3 * x + wander[0] + 0.4 * y) * (0.6 + 0.4 * (y - self.top_m) / 3.0)
        height = curtain.folds_m * pleats * deep
        for _ in range(_WAVES):
            angle, length = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(0.1), np.log(0.9)))
            across = (np.cos(angle) * x + np.sin(angle) * y) * (2 * np.pi / length)
            sideways = (np.cos(angle) * y - np.sin(angle) * x) * (1.3 / length)
            waves = np.cos(across + rng.uniform(0, 6) + 0.8 * np.cos(2 * sideways))
            waves = waves * np.cos(sideways + rng.uniform(0, 6))
            height = height + curtain.wrinkles_m * (2 / np.sqrt(_WAVES)) * waves * (length / 0.3)
        self._height = np.maximum(height, 0).astype(np.float32)
        down, right = np.gradient(self._height, _CELL_M)
        normals = np.stack([right, down, -np.ones_like(right)], -1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        light = _irradiance(normals, look)
        nodes = rng.standard_normal((4, 6), dtype=np.float32)
        uneven = cv2.resize(nodes, height.shape[::-1], interpolation=cv2.INTER_CUBIC)
        light *= np.exp(curtain.uneven * uneven)[..., None]
        light *= 1 - _OCCLUDED * np.minimum(self._height / max(curtain.folds_m, 1e-6), 1)[..., None]
        light *= 1 + 0.06 * rng.standard_normal((*height.shape, 1), dtype=np.float32)  # the weave
        self.colour = (light * curtain.albedo).astype(np.float32)

    def meet(self, ray_x: np.ndarray, ray_y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth `(H, W)` where rays meet it, its colour `(H, W, 3)` there, and whether they do `(H, W)`."""
        z: np.ndarray = np.full(ray_x.shape, self.behind_m, np.float32)
        for _ in range(4):  # folds are shallow: it converges
            z = self.behind_m + self._at(self._height, ray_x * z, ray_y * z)
        x, y = ray_x * z, ray_y * z
        is_met = (np.abs(x) < self.half_m) & (y < self.bottom_m) & (y > self.top_m)
        return z, self._at(self.colour, x, y), is_met

    def _at(self, grid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        columns, rows = ((x - self._origin[0]) / _CELL_M, (y - self._origin[1]) / _CELL_M)
        return cv2.remap(
            *(grid, columns.astype(np.float32), rows.astype(np.float32)),
            *(cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE),
        )


@dataclass(frozen=True)
class _Room:
    cloth: _Cloth | None
    look: Look
    floor_m: float
    wall_m: float
    tone: np.ndarray

    def picture(self, camera: Camera, finer: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear RGB `(h, w, 3)`, depth `(h, w)` and what is seen: 0 floor, 1 curtain, 2 wall."""
        u = (np.arange(finer * camera.width, dtype=np.float32) + 0.5) / finer - 0.5
        v = (np.arange(finer * camera.height, dtype=np.float32) + 0.5) / finer - 0.5
        ray_x, ray_y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        ray_x, ray_y = ray_x.astype(np.float32), ray_y.astype(np.float32)
        kind = np.full(ray_x.shape, 2)
        depth = np.full(ray_x.shape, self.wall_m, np.float32)
        colour = np.empty((*ray_x.shape, 3), np.float32)
        colour[:] = _WALL * _irradiance(np.array([0.0, 0.0, -1.0]), self.look)
        if self.cloth is not None:
            z, cloth, is_met = self.cloth.meet(ray_x, ray_y)
            kind[is_met], depth[is_met], colour[is_met] = 1, z[is_met], cloth[is_met]
        with np.errstate(divide="ignore"):
            floor = np.where(ray_y > 0, self.floor_m / np.maximum(ray_y, 1e-9), np.inf)
        is_floor = floor < depth
        kind[is_floor], depth[is_floor] = 0, floor[is_floor]
        light = _FLOOR * _irradiance(np.array([0.0, -1.0, 0.0]), self.look)
        # Boards 12 cm wide that run towards the camera, with dark joints.
        across = np.where(is_floor, ray_x * depth / 0.12, 0) + 500
        along = np.where(is_floor, depth / 1.4, 0)
        board = across.astype(int)
        along = along + 0.37 * (board % 5)
        joint = np.where(across - board < 0.06, 0.75, 1)[..., None]
        floor_colour = light * joint * self.tone[board % 64, along.astype(int) % 64]
        if self.cloth is not None:  # what the curtain throws on the floor before it
            near = np.exp(-np.maximum(self.cloth.behind_m - depth, 0) / 0.35)[..., None]
            floor_colour = floor_colour + 0.25 * near * self.cloth.colour[-1].mean(0)
        colour[is_floor] = floor_colour[is_floor]
        return colour, depth, kind
