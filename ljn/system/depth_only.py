"""The person's pixels in depth alone, without a curtain."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2
import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.depth import AREA_M2
from ljn.pipeline.inputs import read_depth
from ljn.pipeline.person import NEAR_M, find_person
from ljn.pipeline.report import Report
from ljn.pipeline.scene import find_in_scene
from ljn.system.floor import tolerance_m
from ljn.system.recording import RgbdFrame
from ljn.system.segmentation import nobody, one_person

_APART_M = 0.2
"""Persons who are nearer to each other than this are one to a depth image."""
_STEP_M = 0.7
"""Nobody is farther from where they were in the frame before."""
_FORGOTTEN_S = 1.0
_FPS = 30.0


def background_plate(frames: Iterable[RgbdFrame]) -> np.ndarray:
    """The median depth of frames without anybody.

    Args:
        frames: Some ten of them, of a camera that stands still.

    Returns:
        `(H, W)` float32, metres; 0 where fewer than a half of them measured anything.

    Raises:
        ValueError: No frame has depth, or they differ in size.
    """
    images = [frame.depth for frame in frames if frame.depth is not None]
    if not images or len({image.shape for image in images}) > 1:
        shapes = sorted({image.shape for image in images})
        raise ValueError(f"frames: expected depth images of one size without anybody, got {shapes or 'none'}")
    stack = np.stack(images).astype(np.float32)
    stack[stack <= 0] = np.nan
    is_measured = 2 * np.count_nonzero(np.isfinite(stack), axis=0) >= len(images)
    plate = np.zeros(images[0].shape, np.float32)
    plate[is_measured] = np.nanmedian(stack[:, is_measured], axis=0)
    return plate


class DepthOnly:
    """Finds a person by depth alone, and remembers where it was.

    With a background plate, what is nearer than the plate is taken, and of it the largest thing that hangs together in
    space. Without one, floor, walls and other planes are taken away, and of what is left the figure that is most like
    a person (`ljn.pipeline.scene`). Where there are several, the one that is nearest to where the person was in the
    frame before: so frames come in their order, and the first should show one person alone. `seed` says where that
    one is, if not.

    Attributes:
        facts: What was found in the last frame: `area_m2`, `place` (metres, camera frame), and without a plate what
            `find_in_scene` says.
        doubts: Whether it was clear who the person is, where that was not known from the frame before.
    """

    def __init__(
        self, plate: np.ndarray | str | Path | None = None, seed: tuple[float, float, float] | None = None
    ) -> None:
        """Prepares to look.

        Args:
            plate: `(H, W)`, metres, as of `background_plate`; or a file of it, such as a 16-bit PNG in millimetres.
            seed: A point near the person in the first frame, metres, camera frame; None for the most likely figure.
        """
        if seed is not None and (len(seed) != 3 or not np.isfinite(seed).all()):
            raise ValueError(f"seed: expected three numbers, metres in the camera frame, got {seed!r}")
        self.plate = _read(plate) if isinstance(plate, str | Path) else plate
        self.facts: dict[str, object] = {}
        self.doubts: list[str] = []
        self._last = None if seed is None else np.array(seed, float)
        self._last_s = -np.inf if seed is None else np.inf

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Where the person was, as arrays by name: to go on from."""
        return {} if self._last is None else {"place": self._last, "seconds": np.array(self._last_s)}

    @state.setter
    def state(self, state: Mapping[str, np.ndarray]) -> None:
        self._last = state.get("place")
        self._last_s = float(state.get("seconds", -np.inf))

    def __call__(self, frame: RgbdFrame, camera: Camera) -> np.ndarray:
        """The person's pixels.

        Args:
            frame: The frame.
            camera: Its camera.

        Returns:
            `(H, W)` bool.

        Raises:
            ValueError: The frame has no depth, there is nobody, or of several it is not clear which.
        """
        depth = frame.depth
        if frame.error is not None or depth is None:
            raise ValueError(f"frame: expected a depth image, got none ({frame.error or 'nothing was read'})")
        if depth.shape != (camera.height, camera.width):
            raise ValueError(
                f"frame.depth: expected the camera's {camera.width} x {camera.height} (width x height) pixels, got "
                f"{depth.shape[1]} x {depth.shape[0]}"
            )
        if not depth.any():
            raise ValueError(nobody("nothing was measured"))
        seconds = frame.number / _FPS if frame.timestamp_s is None else frame.timestamp_s
        if np.isfinite(self._last_s) and seconds - self._last_s > _FORGOTTEN_S:
            self._last = None
        self.facts, self.doubts = {}, []
        found = self._before_plate(depth, camera) if self.plate is not None else self._in_room(depth, camera)
        self._last, self._last_s = _place(found, camera), seconds
        self.facts["place"] = [round(float(value), 3) for value in self._last]
        self.facts["area_m2"] = round(float((found[found > 0] ** 2).sum()) / (camera.fx * camera.fy), 3)
        return found > 0

    def _before_plate(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """The person's own depth `(H, W)`."""
        assert self.plate is not None
        if self.plate.shape != depth.shape:
            raise ValueError(
                f"plate: expected {depth.shape[1]} x {depth.shape[0]} (width x height) pixels as the frames have, got "
                f"{self.plate.shape[1]} x {self.plate.shape[0]}"
            )
        is_before = (depth > 0) & ((depth < self.plate - tolerance_m(depth)) | (self.plate == 0))
        # Single pixels are noise of the plate's edges.
        is_before &= cv2.medianBlur(is_before.astype(np.uint8), 3) > 0
        metres = np.where(is_before, depth, np.float32(0))
        if self._last is None:
            return one_person(metres, camera).depth
        left, figures = metres, []
        while left.any():
            figure = find_person(left, camera, _APART_M)
            if figure.area_m2 < AREA_M2[0]:
                break
            figures.append(figure.depth)
            left = np.where(figure.depth > 0, np.float32(0), left)
        distances = [self._away_m(figure, camera) for figure in figures]
        if not distances or min(distances) > _STEP_M:
            return one_person(metres, camera).depth
        chosen = figures[int(np.argmin(distances))]
        others = sum(figure for figure in figures if figure is not chosen)
        # Its hands, too, where they are apart from it in the image.
        return find_person(np.where(others > 0, np.float32(0), metres), camera, NEAR_M / 2).depth

    def _in_room(self, depth: np.ndarray, camera: Camera) -> np.ndarray:
        report = Report()
        if self._last is not None:
            try:  # `find_in_scene` refuses what is farther than 0.15 from it
                return self._found(depth, camera, report, 0.15 / _STEP_M)
            except ValueError:
                pass
        return self._found(depth, camera, report, None)

    def _found(self, depth: np.ndarray, camera: Camera, report: Report, scale: float | None) -> np.ndarray:
        misfit = None if scale is None else lambda figure: scale * self._away_m(figure, camera)
        found = find_in_scene(depth, camera, report, misfit).depth
        self.facts |= {name: value for name, value in report.facts.items() if name != "misfit_mm"}
        if misfit is None:
            self.doubts = [f"{doubt}, or segmentation.seed" for doubt in report.warnings]
        return found

    def _away_m(self, figure: np.ndarray, camera: Camera) -> float:
        assert self._last is not None
        return float(np.linalg.norm(_place(figure, camera) - self._last))


def _place(figure: np.ndarray, camera: Camera) -> np.ndarray:
    """The middle `(3,)` of a figure in a depth image, metres, camera frame."""
    v, u = np.nonzero(figure)
    z = figure[v, u]
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    return np.median(points, axis=1)


def _read(path: str | Path) -> np.ndarray:
    depth = np.asarray(read_depth(Path(path)))
    return depth.astype(np.float32) / (1000 if depth.dtype.kind in "iu" else 1)
