"""What is behind the person."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

BACKGROUNDS = ("black", "random", "green", "own")
_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
_COARSER = 4
_GREEN = np.array([0.16, 0.55, 0.22])


@dataclass(frozen=True)
class Background:
    """What is behind the person.

    Attributes:
        kind: `black` (the person's mask is applied; what it wrongly takes is of a green curtain or of a random image),
            `random` (images made at random, or those of `path`), `green` (a plain green curtain, unevenly lit) or `own`
            (what is there in the frame, of a source of frames).
        path: A folder of images, also in folders below it, for `random`; None for images made at random.
    """

    kind: str = "black"
    path: str | Path | None = None

    def __post_init__(self) -> None:
        if self.kind not in BACKGROUNDS:
            raise ValueError(f"background.kind: expected one of {', '.join(BACKGROUNDS)}, got '{self.kind}'")

    def check(self) -> None:
        """Raise a `FileNotFoundError` where `path` holds no image."""
        if self.path is not None and not self._files:
            raise FileNotFoundError(
                f"background.path: no image ({', '.join(_SUFFIXES)}) in the folder '{self.path}'; null makes images at "
                "random"
            )

    @property
    def _files(self) -> list[Path]:
        return _images_in(str(self.path))

    def image(self, height: int, width: int, rng: np.random.Generator) -> np.ndarray:
        """A background `(h, w, 3)` float32, RGB in 0-1."""
        if self.kind == "black":  # of which a rim is seen at most
            kind = "green" if rng.random() < 0.5 else "random"
            coarse = replace(self, kind=kind).image(height // _COARSER, width // _COARSER, rng)
            return cv2.resize(coarse, (width, height))
        if self.kind == "green":
            return _curtain(height, width, rng)
        if self.path is not None:
            return _part_of(self._files[int(rng.integers(len(self._files)))], height, width, rng)
        return _random_image(height, width, rng)


@lru_cache(maxsize=8)
def _images_in(folder: str) -> list[Path]:
    return sorted(path for path in Path(folder).rglob("*") if path.suffix.lower() in _SUFFIXES)


def _curtain(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Green cloth: its light varies smoothly, and in folds from top to bottom."""
    uneven = rng.uniform(0, 0.15) * _smooth((3, 3), height, width, rng)
    uneven += rng.uniform(0, 0.1) * _smooth((2, int(rng.integers(6, 30))), height, width, rng)
    colour = rng.uniform(0.6, 1.3) * _GREEN * (1 + 0.15 * rng.standard_normal(3))
    return np.minimum(cv2.exp(uneven)[..., None] * colour, 1).astype(np.float32)


def _random_image(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Gradients, noise of several scales, stripes and shapes."""
    vivid = rng.random() ** 2  # most are pale, as rooms are
    tints = 0.5 + 0.25 * rng.standard_normal((4, 1)) + 0.25 * vivid * rng.standard_normal((4, 3))
    image = tints[0] + 0.2 * _smooth((3, 3), height, width, rng)[..., None] * (tints[1] + 0.5)
    for cells in (8, 24, 64):
        if rng.random() < 0.6:
            noise = _smooth((cells, cells), height, width, rng)[..., None]
            image += rng.uniform(0, 0.2) * noise * (0.5 + tints[2])
    if rng.random() < 0.3:
        rows, columns = np.mgrid[:height, :width]
        angle, period = rng.uniform(0, np.pi), rng.uniform(4, 40)
        waves = np.sin(2 * np.pi / period * (np.cos(angle) * columns + np.sin(angle) * rows))
        image += 0.15 * waves[..., None] * tints[3]
    image = np.ascontiguousarray(image, np.float32)
    for _ in range(int(rng.integers(0, 14))):
        colour = np.clip(
            0.5 + 0.3 * rng.standard_normal() + 0.3 * vivid * rng.standard_normal(3), 0, 1
        ).tolist()
        (u, v), (a, b) = rng.random(2) * (width, height), (2 + 0.3 * height * rng.random(2) ** 2)
        centre, axes = (int(u), int(v)), (int(a), int(b))
        thickness = -1 if rng.random() < 0.6 else int(rng.integers(1, 5))
        kind = int(rng.integers(4))
        if kind == 0:
            cv2.rectangle(image, (int(u - a), int(v - b)), (int(u + a), int(v + b)), colour, thickness)
        elif kind == 1:
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, colour, thickness)
        elif kind == 2:
            end = (rng.random(2) * (width, height)).astype(int).tolist()
            cv2.line(image, centre, end, colour, int(rng.integers(1, 8)))
        else:
            corners = np.rint(centre + np.array(axes) * rng.standard_normal((5, 2))).astype(np.int32)
            cv2.fillPoly(image, [corners], colour)
    return np.clip(image, 0, 1)


def _smooth(cells: tuple[int, int], height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Noise `(h, w)` float32 of standard deviation 1 at the nodes of a grid, smooth between them."""
    nodes = rng.standard_normal(cells, dtype=np.float32)
    return cv2.resize(nodes, (width, height), interpolation=cv2.INTER_CUBIC)


def _part_of(path: Path, height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """A random part of an image, of the crop's aspect."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"background.path: '{path}' cannot be read as an image; remove it from the folder")
    largest = min(image.shape[0] / height, image.shape[1] / width)
    rows, columns = (max(1, int(size * largest * rng.uniform(0.3, 1))) for size in (height, width))
    top, left = (int(rng.integers(whole - part + 1)) for whole, part in zip(image.shape, (rows, columns)))
    part = image[top : top + rows, left : left + columns, ::-1]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
