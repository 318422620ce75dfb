"""From a pose record to a colour crop: a body with a look, before a background, photographed."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from datamodules.placement import HEADINGS
from datamodules.posing import BodySynthesizer, SampleKey
from datamodules.rgb import kernels
from datamodules.rgb.backgrounds import Background
from datamodules.rgb.chain import Photo, Photography
from datamodules.rgb.drawing import drawn
from datamodules.rgb.look import Look
from datamodules.rgb.surface import surface_of
from datamodules.scenes import Scene, mirrored
from datamodules.sources import PoseRecords
from ljn.body import BodyModel
from ljn.cloud.rgb import RgbRecipe, Window, body_window
from ljn.data import Batch
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotation_about
from ljn.render import Renderer, get_renderer

_LOOK, _PHOTO, _CROP, BACKGROUND = 9, 10, 11, 12  # see datamodules.posing
FINER = 2  # times as many pixels along a side are rendered as the crop has


@dataclass(frozen=True)
class RgbSettings:
    """How bodies come before the camera, and how training crops are varied.

    Attributes:
        heading: `uniform`, `histogram` or `source`; see `draw_heading`.
        distance_m: Range of the depth of the body's centre, metres; it is raised until the body fits into the image.
        margin_px: Clear border around the body, pixels of the camera's image.
        focal_factors: Range of each sample's focal length in the same image, as multiples of the camera's.
        scale: Range of the size of a training crop's window, as multiples of the window of the body.
        shift: Greatest shift of a training crop's window along a side, as a share of its size.
        rotation_deg: Greatest angle by which the camera of a training crop is turned about its optical axis, degrees.
        mirrored: Share of training samples that are shown mirrored.
    """

    heading: str = "uniform"
    distance_m: tuple[float, float] = (1.5, 4.0)
    margin_px: float = 8.0
    focal_factors: tuple[float, float] = (0.7, 1.4)
    scale: tuple[float, float] = (0.7, 1.35)
    shift: float = 0.08
    rotation_deg: float = 45.0
    mirrored: float = 0.5

    def __post_init__(self) -> None:
        if self.heading not in HEADINGS:
            raise ValueError(f"heading: expected one of {', '.join(HEADINGS)}, got '{self.heading}'")
        for name in ("distance_m", "focal_factors", "scale"):
            values = getattr(self, name)
            if (
                not isinstance(values, Sequence)
                or len(values) != 2
                or not 0 < values[0] <= values[1] < math.inf
            ):
                raise ValueError(f"{name}: expected two numbers, 0 < lowest <= highest, got {values!r}")
            object.__setattr__(self, name, tuple(map(float, values)))
        for name, most in {"margin_px": math.inf, "shift": 1, "rotation_deg": 180, "mirrored": 1}.items():
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0 <= value <= most and math.isfinite(value)):
                raise ValueError(f"{name}: expected a number between 0 and {most:g}, got {value!r}")
            object.__setattr__(self, name, float(value))

    @property
    def pixel_factors(self) -> tuple[float, float]:
        """The camera's image has always its pixels: a crop does not depend on them."""
        return (1.0, 1.0)

    def without_variation(self) -> "RgbSettings":
        """The same for crops as a network sees them in use: the window of the body, upright, not mirrored."""
        return replace(self, scale=(1.0, 1.0), shift=0.0, rotation_deg=0.0, mirrored=0.0)


class Picture(NamedTuple):
    """A crop and its camera.

    Attributes:
        crop: `(3, h, w)` uint8.
        intrinsics: `(4,)`: fx, fy, cx, cy in the crop's pixels.
    """

    crop: np.ndarray
    intrinsics: np.ndarray

    def mirrored(self) -> "Picture":
        """The picture as a mirror shows it."""
        fx, fy, cx, cy = self.intrinsics
        return Picture(self.crop[..., ::-1], np.array([fx, fy, self.crop.shape[-1] - 1 - cx, cy]))


class Variation(NamedTuple):
    """How a crop differs from the upright window of the body."""

    roll: float
    scale: float
    shift: np.ndarray
    is_mirrored: bool


class RgbSynthesizer(BodySynthesizer):
    """Renders colour crops of a table of records; see `BodySynthesizer`.

    A crop is rendered by its own camera, finer than it is, and never cut from a whole image.

    Args:
        records: The poses and shapes.
        bodies: A body for each gender among the records.
        camera: The colour camera.
        settings: See `RgbSettings`.
        recipe: Size of the crops.
        background: What is behind the person.
        seed_key: See `BodySynthesizer`.
        dtype: See `BodySynthesizer`.
        photo: The chain that makes the picture; None for a figure without clothes in plain light, perfectly taken.
    """

    lazy = ("_smpl", "_renderer")
    sensor: Photography | None

    def __init__(
        self,
        records: PoseRecords,
        bodies: Sequence[BodyModel],
        camera: Camera,
        settings: RgbSettings,
        recipe: RgbRecipe,
        background: Background,
        seed_key: tuple[int, int],
        dtype: torch.dtype = torch.float32,
        photo: Photography | None = None,
    ) -> None:
        super().__init__(records, bodies, camera, settings, seed_key, dtype, photo)
        self.settings = settings
        self.recipe = recipe
        self.background = background

    @cached_property
    def _renderer(self) -> Renderer:
        return get_renderer("zbuffer")

    def batch(self, keys: Sequence[SampleKey]) -> Batch:
        """See `BodySynthesizer`."""
        variations = [self._variation(key) for key in keys]
        which = [variation.is_mirrored for variation in variations]
        with _one_thread():
            scene, pictures = self._pictures(keys, variations)
        scene = mirrored(scene, which)
        pictures = [picture.mirrored() if turn else picture for picture, turn in zip(pictures, which)]
        return Batch(
            rgb=torch.from_numpy(np.stack([picture.crop for picture in pictures])),
            rgb_camera=torch.from_numpy(
                np.stack([picture.intrinsics for picture in pictures]).astype(np.float32)
            ),
            joints=scene.joints.float(),
            pose=scene.pose.float(),
            betas=scene.betas.float(),
            gender=scene.gender,
            camera=torch.stack([camera.intrinsics() for camera in scene.cameras]),
            sample_id=torch.tensor([key[1] for key in keys]),
        )

    def _pictures(
        self, keys: Sequence[SampleKey], variations: Sequence[Variation]
    ) -> tuple[Scene, list[Picture]]:
        """The bodies before their cameras, and the picture of each; nothing of either is mirrored yet."""
        posed = self._posed(keys, is_dressed=True)
        pictures = [
            self._picture(key, variation, mesh, int(code), camera)
            for key, variation, mesh, code, camera in zip(
                keys, variations, posed.vertices.numpy(), posed.gender, posed.cameras
            )
        ]
        return Scene(posed.pose, posed.betas, posed.gender, posed.joints, posed.cameras, []), pictures

    def _variation(self, key: SampleKey) -> Variation:
        settings, rng = self.settings, self._rng(key, _CROP)
        roll = math.radians(settings.rotation_deg) * rng.uniform(-1, 1)
        low, high = settings.scale
        scale = math.exp(rng.uniform(math.log(low), math.log(high)))
        return Variation(
            roll, scale, settings.shift * rng.uniform(-1, 1, 2), bool(rng.random() < settings.mirrored)
        )

    def _as_seen(self, keys: Sequence[SampleKey], root: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
        """See `BodySynthesizer`: the camera is turned about its optical axis, which is the body world's x."""
        root, betas = super()._as_seen(keys, root, betas)
        roll = torch.tensor([self._variation(key).roll for key in keys], dtype=root.dtype)
        return rotation_about("x", roll) @ root, betas

    def _picture(
        self, key: SampleKey, variation: Variation, vertices: np.ndarray, gender: int, camera: Camera
    ) -> Picture:
        """The picture of a mesh `(V, 3)`, metres, camera frame."""
        height, width = self.recipe.height_px, self.recipe.width_px
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        window = self._window(kernels.image_box(vertices, intrinsics), variation)
        look = Look()
        if self.sensor is not None:
            self.sensor.style(look, self._seed(key, _LOOK))
        fine = window.intrinsics(intrinsics, FINER * width, FINER * height)
        person, mask = self._render(vertices, gender, fine, look)
        behind = self.background.image(height, width, self._rng(key, BACKGROUND))
        photo = Photo(kernels.composed(person, mask, behind), mask)
        if self.sensor is not None:
            self.sensor.photograph(photo, self._seed(key, _PHOTO))
        crop = kernels.finished(photo.rgb, photo.mask, self.background.kind == "black")
        return Picture(crop, window.intrinsics(intrinsics, width, height))

    def _window(self, box: tuple[float, float, float, float], variation: Variation) -> Window:
        """The window around a body, by its first and last column, first and last row."""
        left, top, width, height = body_window(*box, self.recipe)
        across, down = width * variation.scale, height * variation.scale
        left += (width - across) / 2 + variation.shift[0] * across
        top += (height - down) / 2 + variation.shift[1] * down
        return Window(left, top, across, down)

    def _render(
        self, vertices: np.ndarray, gender: int, intrinsics: np.ndarray, look: Look
    ) -> tuple[np.ndarray, np.ndarray]:
        """The person `(2 h, 2 w, 3)` float32, linear RGB, black around; and the mask `(2 h, 2 w)` uint8."""
        size = FINER * self.recipe.height_px, FINER * self.recipe.width_px
        return drawn(vertices, surface_of(self._body_of[gender]), look, intrinsics, size, self._renderer)


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV without threads of its own, which a worker process that was forked would wait for without end."""
    number = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(number)
