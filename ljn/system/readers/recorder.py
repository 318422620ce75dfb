"""Recordings written in our own folder format."""

import os
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from ljn.geometry.camera import Camera
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import as_lens_camera
from ljn.system.recording import RgbdFrame


class Recorder:
    """Writes frames into a folder that `open_recording` reads; what is there after each frame is whole.

    Args:
        folder: A new or empty folder.
        camera: The depth camera.
        rgb_camera: The colour camera, of colours as it has taken them; None for colours that are registered.
        rgb_suffix: `.png`, or `.jpg` for smaller files.

    Raises:
        FileExistsError: The folder is not empty.
        ValueError: Another suffix.
    """

    def __init__(
        self,
        folder: str | Path,
        camera: Camera | LensCamera,
        rgb_camera: Camera | LensCamera | None = None,
        rgb_suffix: str = ".png",
    ) -> None:
        if rgb_suffix not in (".png", ".jpg"):
            raise ValueError(f"rgb_suffix: expected .png or .jpg, got {rgb_suffix!r}")
        self.folder = Path(folder)
        if self.folder.exists() and any(self.folder.iterdir()):
            raise FileExistsError(f"folder: '{self.folder}' is not empty; give another one")
        self._camera = as_lens_camera(camera)
        self._rgb_camera = None if rgb_camera is None else as_lens_camera(rgb_camera)
        self._rgb_suffix = rgb_suffix
        (self.folder / "depth").mkdir(parents=True, exist_ok=True)
        _write_text(self.folder / "camera.yaml", _yaml(self._camera))
        if self._rgb_camera is not None:
            _write_text(self.folder / "rgb_camera.yaml", _yaml(self._rgb_camera))
        self._times: TextIO | None = None

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file of timestamps."""
        if self._times is not None:
            self._times.close()
            self._times = None

    def write(self, frame: RgbdFrame) -> None:
        """Add a frame: its depth in whole millimetres, its colours and time; one without depth is left out.

        Raises:
            ValueError: An image has another size or type than the cameras say.
        """
        import cv2

        if frame.depth is None:
            return
        depth, rgb = np.asarray(frame.depth), frame.rgb
        _check("depth", depth, (self._camera.camera.height, self._camera.camera.width), "f")
        millimetres = np.rint(np.nan_to_num(depth, nan=0, posinf=0, neginf=0) * 1000)
        millimetres[(millimetres < 0) | (millimetres >= 65000)] = 0
        if rgb is not None:
            camera = (self._rgb_camera or self._camera).camera
            _check("rgb", rgb, (camera.height, camera.width, 3), "u")
            (self.folder / "rgb").mkdir(exist_ok=True)
            path = self.folder / "rgb" / f"{frame.name}{self._rgb_suffix}"
            options = (
                [cv2.IMWRITE_PNG_COMPRESSION, 1]
                if self._rgb_suffix == ".png"
                else [cv2.IMWRITE_JPEG_QUALITY, 95]
            )
            _write_image(path, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)
        path = self.folder / "depth" / f"{frame.name}.png"
        _write_image(path, millimetres.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if frame.timestamp_s is not None:
            if self._times is None:
                self._times = (self.folder / "timestamps.csv").open("w", encoding="utf-8")
                self._times.write("name,timestamp_s\n")
            self._times.write(f"{frame.name},{frame.timestamp_s:.6f}\n")
            self._times.flush()


def _check(name: str, image: np.ndarray, shape: tuple[int, ...], kind: str) -> None:
    if image.shape != shape or image.dtype.kind != kind or (kind == "u" and image.dtype.itemsize != 1):
        expected = "float metres" if kind == "f" else "uint8"
        raise ValueError(
            f"{name}: expected {expected} of shape {shape}, the camera's, got {image.dtype} of shape {image.shape}"
        )


def _write_image(path: Path, image: np.ndarray, options: list[int]) -> None:
    """In one step: a file of this name is whole."""
    import cv2

    is_written, content = cv2.imencode(path.suffix, image, options)
    if not is_written:
        raise ValueError(f"'{path}' cannot be written")
    _replace(path, content.tobytes())


def _write_text(path: Path, text: str) -> None:
    _replace(path, text.encode())


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def _yaml(camera: LensCamera) -> str:
    """A camera's file, as `read_lens_camera` reads it."""
    import yaml

    values: dict[str, Any] = {
        key: int(value) if key in ("width", "height") else float(value)
        for key, value in vars(camera.camera).items()
    }
    if camera.distortion:
        values["distortion_coefficients"] = [float(number) for number in camera.distortion]
    if camera.rgb_from_depth is not None:
        values["extrinsics"] = {
            "rotation": camera.motion[:3, :3].tolist(),
            "translation": camera.motion[:3, 3].tolist(),
        }
    head = "# Pixels; pixel centres are at whole numbers. Extrinsics take points from the depth camera, metres.\n"
    return head + yaml.safe_dump(values, sort_keys=False, default_flow_style=None)
