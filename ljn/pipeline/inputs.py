"""Reading what a user has: depth images, masks, cameras and keypoints."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ljn.geometry.camera import MAX_PIXELS, Camera
from ljn.pipeline.depth import person_mask
from ljn.reading import READ_ERRORS, brief, read_arrays, read_json, read_yaml, reason, shown

DEPTH_SUFFIXES = (".png", ".npy", ".npz")
_GREY = ("1", "L", "I", "I;16", "I;16B", "F")  # Pillow's modes of one channel
_CAMERA_KEYS = ("fx", "fy", "cx", "cy", "width", "height")


def read_depth(path: str | Path) -> np.ndarray:
    """A depth image as it is stored: integer millimetres or floating-point metres, not yet checked (`body_depth`).

    It is a PNG of 16 bits, a `.npy`, or a `.npz` that holds one array or one with the key `depth`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not a depth image.
    """
    path = _existing(path, "depth")
    if path.suffix.lower() not in DEPTH_SUFFIXES:
        raise ValueError(f"depth: expected one of {', '.join(DEPTH_SUFFIXES)}, got '{path}'")
    if path.suffix.lower() == ".png":
        image = _read_png(path, "depth")
        if image.ndim != 2 or image.dtype.itemsize < 2:
            raise ValueError(
                f"depth: expected a PNG of 16 bits with one channel, millimetres; '{path}' has {image.dtype} and shape "
                f"{image.shape}: a picture of the depth? Save the sensor's own values"
            )
        return image
    try:
        arrays = read_arrays(path)
    except READ_ERRORS as error:
        raise _unreadable("depth", path, error) from error
    if len(arrays) == 1 or "depth" in arrays:
        return arrays["depth"] if "depth" in arrays else next(iter(arrays.values()))
    raise ValueError(
        f"depth: expected one array or one with the key 'depth' in '{path}', got {shown(list(arrays))}"
    )


def read_mask(path: str | Path, chosen: int | None = None) -> np.ndarray:
    """A mask `(H, W)` bool from a PNG: black and white, a soft matte, a cut-out with alpha, or an index map.

    Args:
        path: The file.
        chosen: See `person_mask`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is no mask of one person.
    """
    path = _existing(path, "mask")
    try:
        return person_mask(_read_png(path, "mask", (*_GREY, "P", "LA", "RGBA")), chosen)
    except ValueError as error:
        raise ValueError(f"{error} ('{path}')") from error


def read_camera(path: str | Path) -> Camera:
    """A camera from YAML or JSON with fx, fy, cx, cy, width and height, pixels; pixel centres at integers.

    Cameras here have no distortion: undistort images first. Keys that begin with `_` are passed over, so the files in
    `conf/data/camera` can be read.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, keys are missing or unknown, or a value is not what its key needs.
    """
    path = _existing(path, "camera")
    try:
        content = read_yaml(path)
    except READ_ERRORS as error:
        raise _unreadable("camera", path, error) from error
    expected = f"camera: expected the keys {', '.join(_CAMERA_KEYS)} in '{path}'"
    if not isinstance(content, dict):
        raise ValueError(f"{expected}, got {shown(content)}")
    values = {str(key): value for key, value in content.items() if not str(key).startswith("_")}
    if missing := [key for key in _CAMERA_KEYS if key not in values]:
        raise ValueError(f"{expected}: {', '.join(missing)} are missing")
    if unknown := sorted(values.keys() - set(_CAMERA_KEYS)):
        problem = "are unknown (there is no distortion here: undistort the images)"
        raise ValueError(f"{expected}: {brief(', '.join(unknown))} {problem}")
    fx, fy, cx, cy, width, height = (_camera_number(values[key], key, path) for key in _CAMERA_KEYS)
    for key, size in (("width", width), ("height", height)):
        if not size.is_integer():
            raise ValueError(
                f"camera: {key}: expected a whole number of pixels in '{path}', got {size:g}; give the image's own size"
            )
    return Camera(fx, fy, cx, cy, int(width), int(height))


def read_keypoints(path: str | Path) -> Any:
    """Keypoints from JSON, in any of the forms that `smpl_keypoints` takes and checks.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not JSON.
    """
    path = _existing(path, "keypoints")
    try:
        return read_json(path)
    except READ_ERRORS as error:
        raise _unreadable("keypoints", path, error) from error


def _camera_number(value: Any, key: str, path: Path) -> float:
    try:
        # YAML takes 3.6e2, which JSON may hold, for text.
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(
            f"camera: {key}: expected a finite number in '{path}', got {shown(value)}; give it in pixels, such as "
            f"{key}: 366"
        )
    return number


def _read_png(path: Path, name: str, modes: Sequence[str] = _GREY) -> np.ndarray:
    """The image as an array, in RGB unless its mode is one of `modes`."""
    from PIL import Image

    bombs: tuple[type[Exception], ...] = (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        # Another format can start a program: PostScript, also in a file called .png, starts Ghostscript.
        with Image.open(path, formats=("PNG",)) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels, expected at most {MAX_PIXELS}")
            image.verify()  # compares all checksums; then it has to be opened anew
        with Image.open(path, formats=("PNG",)) as image:
            return np.asarray(image if image.mode in modes else image.convert("RGB"))
    except (*bombs, *READ_ERRORS) as error:
        raise _unreadable(name, path, error) from error


def _existing(path: str | Path, name: str) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{name}: no file '{path}'")
    return path


def _unreadable(name: str, path: Path, error: Exception) -> ValueError:
    return ValueError(
        f"{name}: '{path}' is damaged, cut off or of another format ({reason(error)}); write it again"
    )
