"""What a 2D joint detector takes of a colour image: a crop around the person, for training and prediction alike."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ljn.geometry.camera import Camera

_MARGIN = 1.1  # the crop's height or width, whichever the body fills, as a multiple of the body's
_STEP_PX = 32  # what networks halve five times


@dataclass(frozen=True)
class RgbRecipe:
    """How a crop is made. It travels with a model's weights: a model is only meaningful with its recipe.

    Attributes:
        height_px: Height of the crop, pixels, a multiple of 32.
        width_px: Width of the crop, pixels, a multiple of 32.
    """

    height_px: int = 128
    width_px: int = 96

    def __post_init__(self) -> None:
        for name in ("height_px", "width_px"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1 or value % _STEP_PX:
                raise ValueError(f"{name}: expected a positive multiple of {_STEP_PX}, got {value!r}")


class Window(NamedTuple):
    """A rectangle of an image, in its pixels: pixel k is the interval [k, k + 1)."""

    left: float
    top: float
    width: float
    height: float

    def intrinsics(self, intrinsics: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
        """fx, fy, cx, cy `(4,)` of the rectangle with so many pixels, from those of the image; pixel centres at whole
        numbers in both.
        """
        steps = np.array([self.width / width_px, self.height / height_px])
        focal, centre = np.asarray(intrinsics[:2]) / steps, np.asarray(intrinsics[2:])
        return np.concatenate([focal, (centre + 0.5 - (self.left, self.top)) / steps - 0.5])


def body_window(left: float, right: float, top: float, bottom: float, recipe: RgbRecipe) -> Window:
    """The window of a crop around a body: its box with a margin, extended to the crop's aspect.

    Args:
        left: First column of the body, pixels.
        right: Its last column.
        top: Its first row.
        bottom: Its last row.
        recipe: Size of the crop.
    """
    step = _MARGIN * max((right + 1 - left) / recipe.width_px, (bottom + 1 - top) / recipe.height_px)
    width, height = step * recipe.width_px, step * recipe.height_px
    return Window((left + right + 1 - width) / 2, (top + bottom + 1 - height) / 2, width, height)


def crop_rgb(
    rgb: np.ndarray, mask: np.ndarray, camera: Camera, recipe: RgbRecipe, is_black: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """The part of a colour image around a person, by area averages; black outside the image.

    Args:
        rgb: `(H, W, 3)` uint8.
        mask: `(H, W)`, nonzero on the person.
        camera: The camera of this image.
        recipe: Size of the crop.
        is_black: Whether what is outside the mask becomes black.

    Returns:
        `(3, h, w)` uint8; and `(4,)` float32: fx, fy, cx, cy of the crop, in its own pixels.

    Raises:
        ValueError: Image, mask and camera differ in size, or the mask is empty.
    """
    import cv2  # takes a tenth of a second, which only crops are worth

    size = (camera.height, camera.width)
    if rgb.shape != (*size, 3) or rgb.dtype != np.uint8:
        raise ValueError(
            f"rgb: expected uint8 of shape {(*size, 3)}, the camera's image, got {rgb.dtype} of shape {rgb.shape}"
        )
    if mask.shape != size:
        raise ValueError(f"mask: expected shape {size}, that of the image, got {mask.shape}")
    is_person = mask != 0
    rows, columns = np.flatnonzero(is_person.any(1)), np.flatnonzero(is_person.any(0))
    if not len(rows):
        raise ValueError("mask: it is empty, no pixel shows the person")
    exact = body_window(columns[0], columns[-1], rows[0], rows[-1], recipe)
    window = Window(*(max(1, round(side)) if i > 1 else round(side) for i, side in enumerate(exact)))
    left, top, width, height = map(int, window)
    part = np.zeros((height, width, 3), np.uint8)
    u, v = max(0, left), max(0, top)
    seen = slice(v, max(v, top + height)), slice(u, max(u, left + width))
    pixels = rgb[seen] * is_person[seen][..., None] if is_black else rgb[seen]
    part[v - top : v - top + pixels.shape[0], u - left : u - left + pixels.shape[1]] = pixels
    is_reduced = height >= recipe.height_px
    crop = cv2.resize(
        part,
        (recipe.width_px, recipe.height_px),
        interpolation=cv2.INTER_AREA if is_reduced else cv2.INTER_LINEAR,
    )
    intrinsics = window.intrinsics(
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]), recipe.width_px, recipe.height_px
    )
    return np.ascontiguousarray(crop.transpose(2, 0, 1)), intrinsics.astype(np.float32)
