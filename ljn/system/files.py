"""Reading what a user has: depth images, masks, cameras and keypoints."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ljn.geometry.camera import Camera

DEPTH_SUFFIXES = (".png", ".npy", ".npz")
_GREY = ("1", "L", "I", "I;16", "I;16B", "F")  # Pillow's modes of one channel
_CAMERA_KEYS = ("fx", "fy", "cx", "cy", "width", "height")


def read_depth(path: str | Path) -> np.ndarray:
    """A depth image as it is stored: integer millimetres or floating-point metres.

    Args:
        path: A PNG of 16 bits, a `.npy`, or a `.npz` that holds one array or one with the key `depth`.

    Returns:
        The array, unchecked; `ljn.system.depth.body_depth` checks it.

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
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content
        with content:
            names = content.files
            if len(names) == 1 or "depth" in names:
                array: np.ndarray = content["depth" if "depth" in names else names[0]]
                return array
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise _unreadable("depth", path, error) from error
    raise ValueError(f"depth: expected one array or one with the key 'depth' in '{path}', got {names}")


def read_mask(path: str | Path) -> np.ndarray:
    """A mask `(H, W)` bool from a PNG: wherever any channel but alpha is not 0.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read.
    """
    image = _read_png(_existing(path, "mask"), "mask")
    return image != 0 if image.ndim == 2 else np.logical_or.reduce(image, -1)


def read_camera(path: str | Path) -> Camera:
    """A camera from YAML or JSON with fx, fy, cx, cy, width and height, pixels; pixel centres at integers.

    Cameras here have no distortion: undistort images first. Keys that begin with `_` are passed over, so the files in
    `conf/data/camera` can be read.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or keys are missing or unknown.
    """
    path = _existing(path, "camera")
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise _unreadable("camera", path, error) from error
    if not isinstance(content, dict):
        raise ValueError(f"camera: expected the keys {', '.join(_CAMERA_KEYS)} in '{path}', got {content!r}")
    values = {str(key): value for key, value in content.items() if not str(key).startswith("_")}
    for problem, names in (
        ("are missing", [key for key in _CAMERA_KEYS if key not in values]),
        (
            "are unknown (there is no distortion here: undistort the images)",
            sorted(values.keys() - set(_CAMERA_KEYS)),
        ),
    ):
        if names:
            raise ValueError(
                f"camera: expected the keys {', '.join(_CAMERA_KEYS)} in '{path}': {', '.join(names)} {problem}"
            )
    try:
        fx, fy, cx, cy = (float(values[key]) for key in _CAMERA_KEYS[:4])
        return Camera(fx, fy, cx, cy, int(values["width"]), int(values["height"]))
    except TypeError as error:
        raise ValueError(f"camera: expected numbers in '{path}', got {values}") from error


def read_keypoints(path: str | Path) -> Any:
    """Keypoints from JSON, in any of the forms that `smpl_keypoints` takes and checks.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not JSON.
    """
    path = _existing(path, "keypoints")
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise _unreadable("keypoints", path, error) from error


def _read_png(path: Path, name: str) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image if image.mode in _GREY else image.convert("RGB"))
    # What Pillow raises where a file is cut off or is no picture.
    except (OSError, SyntaxError, ValueError) as error:
        raise _unreadable(name, path, error) from error


def _existing(path: str | Path, name: str) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{name}: no file '{path}'")
    return path


def _unreadable(name: str, path: Path, error: Exception) -> ValueError:
    reason = str(error).strip().split("\n")[0]
    return ValueError(f"{name}: '{path}' is damaged, cut off or of another format ({reason}); write it again")
