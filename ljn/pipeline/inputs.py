"""Reading what a user has: depth images, masks, cameras and keypoints."""

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ljn.geometry.camera import MAX_PIXELS, Camera
from ljn.pipeline.depth import person_mask
from ljn.reading import READ_ERRORS, brief, read_arrays, read_json, read_yaml, reason, shown

DEPTH_SUFFIXES = (".png", ".npy", ".npz")
RGB_SUFFIXES = (".png", ".jpg", ".jpeg")
_DEEP = ("I", "I;16", "I;16B", "F")  # those of more than 8 bits
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
    image = _read_png(path, "mask", (*_GREY, "P", "LA", "RGBA"))
    try:
        return person_mask(image, chosen)
    except ValueError as error:
        raise ValueError(f"{error} ('{path}')") from error


def read_rgb(path: str | Path) -> np.ndarray:
    """A colour image `(H, W, 3)` uint8 from a PNG or a JPEG; an alpha channel is left out.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or has no colours.
    """
    path = _existing(path, "rgb")
    if path.suffix.lower() not in RGB_SUFFIXES:
        raise ValueError(f"rgb: expected one of {', '.join(RGB_SUFFIXES)}, got '{path}'")
    image = _read_image(path, "rgb", _DEEP)
    if image.dtype != np.uint8 or image.ndim != 3:
        raise ValueError(
            f"rgb: expected 8 bits a channel, red, green and blue; '{path}' has {image.dtype} and shape {image.shape}: "
            "the depth image?"
        )
    return image


def read_camera(path: str | Path) -> Camera:
    """A camera without distortion from YAML or JSON, pixels; pixel centres at integers.

    Forms: fx, fy, cx, cy, width and height; ROS's `camera_info` and OpenCV's calibration files (`camera_matrix`, image
    width and height); Open3D's (`intrinsic_matrix`, column by column); RealSense's (`ppx`, `ppy`). Keys that begin with
    `_` are passed over, so the files in `conf/data/camera` can be read. Coefficients of a distortion that are not all 0
    are an error.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, keys are missing or unknown, a value is not what its key needs, or images of the
            camera are distorted.
    """
    found = read_camera_file(path)
    if any(found.distortion):
        raise ValueError(
            f"camera: '{path}' has coefficients of a distortion that are not 0, and cameras here have no distortion: "
            "undistort the images (cv2.undistort), and set them to 0"
        )
    return found.camera


class CameraFile(NamedTuple):
    """What a camera's file says."""

    camera: Camera
    distortion: list[float]  # OpenCV's coefficients; none or all 0 without distortion
    model: str  # of the distortion, by the name that the file gives; empty where it gives none
    others: dict[str, Any]  # further keys


def read_camera_file(path: str | Path, others: Collection[str] | None = ()) -> CameraFile:
    """A camera from any file that `read_camera` takes, with the coefficients of its distortion.

    Args:
        path: The file.
        others: Further keys that it may have; None for any.

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
    model = brief(str(next((values[key] for key in _MODELS if key in values), "")))
    values = _of_other_forms({key: value for key, value in values.items() if key not in _MODELS}, path)
    distortion: list[float] = []
    for key in _DISTORTIONS:
        if values.get(key) is not None:
            distortion = _numbers_of(values[key], f"{key} in '{path}'")
        values.pop(key, None)
    if missing := [key for key in _CAMERA_KEYS if key not in values]:
        raise ValueError(f"{expected}: {', '.join(missing)} are missing")
    further = {
        key: values.pop(key) for key in values.keys() - set(_CAMERA_KEYS) if others is None or key in others
    }
    if unknown := sorted(values.keys() - set(_CAMERA_KEYS)):
        problem = f"are unknown (a distortion is given as {_DISTORTIONS[0]}: [k1, k2, p1, p2, k3])"
        raise ValueError(f"{expected}: {brief(', '.join(unknown))} {problem}")
    fx, fy, cx, cy, width, height = (_camera_number(values[key], key, path) for key in _CAMERA_KEYS)
    for key, size in (("width", width), ("height", height)):
        if not size.is_integer():
            raise ValueError(
                f"camera: {key}: expected a whole number of pixels in '{path}', got {size:g}; give the image's own size"
            )
    return CameraFile(Camera(fx, fy, cx, cy, int(width), int(height)), distortion, model, further)


_MATRICES = ("camera_matrix", "K", "k", "intrinsic_matrix")
_DISTORTIONS = ("distortion_coefficients", "distortion", "dist_coeffs", "D", "d", "coeffs")
_MODELS = ("distortion_model", "model")
_RENAMED = {"ppx": "cx", "ppy": "cy", "image_width": "width", "image_height": "height"}
_PASSED_OVER = (
    *(
        "header",
        "camera_name",
        "rectification_matrix",
        "projection_matrix",
        "R",
        "P",
    ),
    *(
        "binning_x",
        "binning_y",
        "roi",
        "calibration_time",
        "board_width",
        "board_height",
        "square_size",
        "flags",
    ),
    *("avg_reprojection_error", "nframes", "r", "p"),
)


def _of_other_forms(values: dict[str, Any], path: Path) -> dict[str, Any]:
    """The six keys' values from those of ROS, OpenCV, Open3D and RealSense, if it is one of theirs."""
    matrix = next((key for key in _MATRICES if key in values), None)
    if matrix is None and "ppx" not in values:
        return values
    values = {_RENAMED.get(key, key): value for key, value in values.items() if key not in _PASSED_OVER}
    if matrix is not None:
        numbers = _numbers_of(values.pop(matrix), f"{matrix} in '{path}'")
        if len(numbers) != 9:
            raise ValueError(f"camera: {matrix}: expected 9 numbers in '{path}', got {len(numbers)}")
        rows = np.reshape(numbers, (3, 3))
        if matrix == "intrinsic_matrix":  # Open3D writes it column by column
            rows = rows.T
        if not np.array_equal(rows[2], [0, 0, 1]):
            raise ValueError(
                f"camera: {matrix}: expected the last row 0, 0, 1 in '{path}', got {rows[2].tolist()}; Open3D's "
                "intrinsic_matrix goes column by column, all others row by row"
            )
        found = {"fx": rows[0, 0], "fy": rows[1, 1], "cx": rows[0, 2], "cy": rows[1, 2]}
        values |= {name: float(value) for name, value in found.items()}
    return values


def _numbers_of(value: Any, name: str) -> list[float]:
    """The numbers of a list, a list of lists, or a mapping with them as `data`."""
    if isinstance(value, dict):
        value = value.get("data")
    try:
        return np.asarray(value, np.float64).ravel().tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(f"camera: expected numbers as {name}, got {shown(value)}") from error


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
    """See `_read_image`."""
    return _read_image(path, name, modes, ("PNG",))


def _read_image(
    path: Path, name: str, modes: Sequence[str], formats: tuple[str, ...] = ("PNG", "JPEG")
) -> np.ndarray:
    """The image as an array, in RGB unless its mode is one of `modes`."""
    from PIL import Image

    bombs: tuple[type[Exception], ...] = (Image.DecompressionBombError, Image.DecompressionBombWarning)
    try:
        # Another format can start a program: PostScript, also in a file called .png, starts Ghostscript.
        with Image.open(path, formats=formats) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels, expected at most {MAX_PIXELS}")
            image.verify()  # compares all checksums; then it has to be opened anew
        with Image.open(path, formats=formats) as image:
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
