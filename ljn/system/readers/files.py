"""Recordings in files, whatever their layout: frames read one by one, checked, aligned."""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import DEPTH_SUFFIXES, RGB_SUFFIXES, read_depth, read_rgb
from ljn.reading import shown
from ljn.system.readers.alignment import Alignment
from ljn.system.readers.cameras import LensCamera, read_lens_camera
from ljn.system.readers.timestamps import frames_a_second, since_first
from ljn.system.readers.video import Video
from ljn.system.recording import RgbdFrame

MILLIMETRES = 1000.0
"""A depth image's units to a metre, where nothing else is said."""
CameraLike = str | Path | Camera | LensCamera
_INVALID = 65000  # codes of sensors for "nothing measured", from here on
_FARTHEST_M = 20.0
_NEAREST_M = 0.4  # of half of an image: nobody is seen whole from there
_PROBES = 8
_CAMERA_NAMES = ("camera.yaml", "camera.yml", "camera.json", "camera_intrinsic.json", "intrinsic.json")
_RGB_CAMERA_NAMES = ("rgb_camera.yaml", "rgb_camera.yml", "rgb_camera.json")


class Entry(NamedTuple):
    """What a recording holds of a frame."""

    name: str
    depth: Path | None  # None where there is none
    rgb: Path | int | None = None  # a picture, or the number of a video's frame; None where there is none
    time_s: float | None = None  # by any clock


class Cameras(NamedTuple):
    """The cameras of a recording and what their files say beside."""

    depth: LensCamera
    rgb: LensCamera | None  # None where colours are registered to the depth, or there are none
    depth_scale: float  # of integers: units to a metre
    fps: float | None


def find_cameras(
    folder: Path,
    camera: CameraLike | None = None,
    rgb_camera: CameraLike | None = None,
    depth_scale: float | None = None,
    default_scale: float = MILLIMETRES,
) -> Cameras:
    """The cameras as given, or from the files beside the images.

    Raises:
        FileNotFoundError: There is no camera file.
        ValueError: It cannot be read, or says something else than a camera.
    """
    others: dict[str, Any] = {}
    if isinstance(camera, Camera | LensCamera):
        depth_camera = as_lens_camera(camera)
    else:
        path = Path(camera) if camera else _first_of(folder, _CAMERA_NAMES)
        if path is None:
            raise FileNotFoundError(
                f"camera: no camera file in '{folder}': looked for {', '.join(_CAMERA_NAMES)}; write camera.yaml with "
                "fx, fy, cx, cy, width and height of the depth images, pixels, or give the file as camera="
            )
        # Open3D's carries much more than a camera.
        known = None if path.name == "intrinsic.json" else ("depth_scale", "fps")
        depth_camera, others = read_lens_camera(path, known)
    if isinstance(rgb_camera, Camera | LensCamera):
        colour_camera: LensCamera | None = as_lens_camera(rgb_camera)
    else:
        path = Path(rgb_camera) if rgb_camera else _first_of(folder, _RGB_CAMERA_NAMES)
        colour_camera = read_lens_camera(path, is_rgb=True)[0] if path else None
    scale = others.get("depth_scale", default_scale) if depth_scale is None else depth_scale
    fps = others.get("fps")
    return Cameras(
        depth_camera,
        colour_camera,
        _positive(scale, "depth_scale", "the units of depth images to a metre, 1000 for millimetres"),
        None if fps is None else _positive(fps, "fps", "frames a second"),
    )


def _positive(value: Any, name: str, meaning: str) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < value < 1e6:
        raise ValueError(f"{name}: expected a positive number, {meaning}, got {shown(value)}")
    return float(value)


def as_lens_camera(camera: Camera | LensCamera) -> LensCamera:
    """A camera with a lens that does not distort, unless it has one."""
    return LensCamera(camera) if isinstance(camera, Camera) else camera


def _first_of(folder: Path, names: Iterable[str]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def find_images(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The images of a folder by stem, in the order of the numbers in their names.

    Raises:
        ValueError: Two share a stem.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        # Files that programs leave behind, such as macOS's ._0001.png, are no images.
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            raise ValueError(
                f"input: '{found[path.stem].name}' and '{path.name}' in '{folder}' are of one frame; keep one of them"
            )
        found[path.stem] = path
    return {stem: found[stem] for stem in sorted(found, key=natural_key)}


def find_depth_images(folder: Path) -> dict[str, Path]:
    """See `find_images`."""
    return find_images(folder, DEPTH_SUFFIXES)


def find_rgb_images(folder: Path) -> dict[str, Path]:
    """See `find_images`."""
    return find_images(folder, RGB_SUFFIXES)


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sorts frame_10 after frame_2."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


class FileRecording:
    """A recording in files (see `ljn.system.recording.Recording`).

    Args:
        path: Its folder.
        layout: The layout's name.
        entries: Its frames, in order.
        cameras: Its cameras.
        facts: What was found in the files so far.
        video: The colours' video, if the entries give numbers of its frames.
        fps: Frames a second where neither times nor the camera's file say them.

    Raises:
        ValueError: There are no frames, or none of some that were tried can be read.
    """

    def __init__(
        self,
        path: Path,
        layout: str,
        entries: Sequence[Entry],
        cameras: Cameras,
        facts: dict[str, object] | None = None,
        video: Path | None = None,
        fps: float | None = None,
    ) -> None:
        self._path, self._entries, self._cameras, self._video = path, list(entries), cameras, video
        self._has_colours = any(entry.rgb is not None for entry in entries)
        self._align = Alignment(cameras.depth, cameras.rgb if self._has_colours else None)
        self._times, time_facts = since_first([entry.time_s for entry in entries])
        self._fps = frames_a_second(self._times) or cameras.fps or fps
        self._unreadable: set[int] = set()
        counts = {
            "frames_without_depth": sum(entry.depth is None for entry in entries),
            "frames_without_colours": sum(entry.rgb is None for entry in entries) * self._has_colours,
        }
        self._facts = {
            "layout": layout,
            "frames": len(entries),
            "size": f"{self.camera.width} x {self.camera.height}",
            "colours": "registered" if self._has_colours else "none",
            **({} if cameras.depth_scale == MILLIMETRES else {"depth_scale": cameras.depth_scale}),
            **self._align.facts,
            **{key: count for key, count in counts.items() if count},
            **time_facts,
            **(facts or {}),
        }
        self._check()

    @property
    def name(self) -> str:
        """Its folder's name."""
        return self._path.resolve().name

    @property
    def camera(self) -> Camera:
        """See `Recording`."""
        return self._align.camera

    @property
    def num_frames(self) -> int:
        """See `Recording`."""
        return len(self._entries)

    @property
    def fps(self) -> float | None:
        """See `Recording`."""
        return self._fps

    @property
    def times(self) -> list[float | None]:
        """Of each frame, seconds since the first; None where nobody knows."""
        return list(self._times)

    @property
    def facts(self) -> dict[str, object]:
        """See `Recording`; frames that could not be read are counted as they come."""
        return {**self._facts, **({"unreadable": len(self._unreadable)} if self._unreadable else {})}

    def frames(self, start: int = 0) -> Iterator[RgbdFrame]:
        """See `Recording`."""
        return self.chosen_frames(range(start, self.num_frames))

    def chosen_frames(self, numbers: Iterable[int]) -> Iterator[RgbdFrame]:
        """The frames of ascending numbers; each number is asked for when its frame is."""
        with ExitStack() as stack:
            video = stack.enter_context(Video(self._video)) if self._video else None
            for number in numbers:
                frame = self._read(number, video)
                if frame.error is not None:
                    self._unreadable.add(number)
                yield frame

    def _read(self, number: int, video: Video | None) -> RgbdFrame:
        entry = self._entries[number]
        depth = rgb = error = None
        try:
            depth = self._depth(entry)
            rgb = self._rgb(entry, video)
        except (ValueError, FileNotFoundError) as caught:
            error = str(caught)
        if depth is not None:
            depth, rgb = self._align(depth, rgb)
        return RgbdFrame(number, entry.name, depth, rgb, self._times[number], error)

    def _depth(self, entry: Entry) -> np.ndarray:
        """`(H, W)` float32, metres."""
        if entry.depth is None:
            raise ValueError(f"depth: no depth image of the frame '{entry.name}', although others have one")
        depth = metres(read_depth(entry.depth), self._cameras.depth_scale)
        size = (self.camera.height, self.camera.width)
        if depth.shape != size:
            raise ValueError(
                f"depth: expected the camera's {_shown(size)} pixels (width x height) in '{entry.depth}', got "
                f"{_shown(depth.shape)}; give the camera of these images"
            )
        return depth

    def _rgb(self, entry: Entry, video: Video | None) -> np.ndarray | None:
        """`(h, w, 3)` uint8 as the colour camera has taken it; None in a recording without colours."""
        if not self._has_colours:
            return None
        if entry.rgb is None:
            raise ValueError(f"rgb: no colour image of the frame '{entry.name}', although others have one")
        if isinstance(entry.rgb, int):
            assert video is not None
            rgb = video.read(entry.rgb)
        else:
            rgb = read_rgb(entry.rgb)
        size, found = self._align.rgb_size, rgb.shape[:2]
        if found != size and self._cameras.rgb is not None:
            raise ValueError(
                f"rgb: expected the colour camera's {_shown(size)} pixels (width x height), got {_shown(found)}; give "
                "the camera of these images in rgb_camera.yaml"
            )
        if found != size:
            raise ValueError(
                f"rgb: images of {_shown(found)} pixels (width x height) beside depth of {_shown(size)} have to be "
                "registered: give their camera, with its extrinsics, as rgb_camera.yaml in the recording or rgb_camera="
            )
        return rgb

    def _check(self) -> None:
        """Read some frames; what is wrong with all of them is an error."""
        if not self._entries:
            raise ValueError(f"input: no frames in '{self._path}'")
        whole = [number for number, entry in enumerate(self._entries) if entry.depth is not None]
        whole = [number for number in whole if self._entries[number].rgb is not None or not self._has_colours]
        if not whole:
            raise ValueError(
                f"input: no frame of '{self._path}' has both depth and colours: give them one name"
            )
        errors, is_readable = [], False
        # A video is decoded from its beginning: its first frames alone.
        probes = whole[:_PROBES] if self._video else whole[:: max(1, len(whole) // _PROBES)]
        for frame in self.chosen_frames(probes):
            if frame.error is not None:
                errors.append(frame.error)
                continue
            is_readable = True
            path = self._entries[frame.number].depth
            if path is not None and _is_plausible(path, self._cameras.depth_scale):
                break
        if not is_readable:
            raise ValueError(
                f"input: none of {len(errors)} frames of '{self._path}' can be read: {errors[0]}"
            )
        self._unreadable.clear()


def metres(depth: np.ndarray, depth_scale: float = MILLIMETRES) -> np.ndarray:
    """A stored depth image in float32 metres, 0 where nothing was measured.

    Args:
        depth: `(H, W)` or `(H, W, 1)`, integers of so many units to a metre, or floating-point metres.
        depth_scale: The units to a metre.

    Raises:
        ValueError: It has another shape or type.
    """
    depth = depth[..., 0] if depth.ndim == 3 and depth.shape[-1] == 1 else depth
    if depth.ndim != 2 or depth.dtype.kind not in "iuf":
        raise ValueError(
            f"depth: expected (H, W) integers or float metres, got {depth.dtype} of shape {depth.shape}"
        )
    if depth.dtype.kind == "f":
        found = np.nan_to_num(depth, nan=0, posinf=0, neginf=0).astype(np.float32)
    else:
        found = depth.astype(np.float32) / np.float32(depth_scale)
        found[depth >= _INVALID] = 0
    found[(found < 0) | (found > _FARTHEST_M)] = 0
    return found


def _is_plausible(path: Path, depth_scale: float) -> bool:
    """Whether a depth image measures what a depth camera does; False where it measures nothing.

    Raises:
        ValueError: Its unit is probably another one.
    """
    depth = read_depth(path)
    is_integer = depth.dtype.kind in "iu"
    measured = depth[(depth > 0) & (depth < (_INVALID if is_integer else np.inf))]
    if not measured.size:
        return False
    median = float(np.median(measured)) / (depth_scale if is_integer else 1)
    if _NEAREST_M < median < _FARTHEST_M:
        return True
    raise ValueError(
        f"depth: half of '{path}' is nearer than {median:g} m: another unit? Integers are millimetres unless "
        "depth_scale in camera.yaml says how many are a metre (5000 in TUM's files), floats metres"
    )


def _shown(size: tuple[int, ...]) -> str:
    return " x ".join(map(str, size[::-1]))
