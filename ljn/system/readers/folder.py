"""Folders of images: our own format, a video beside depth images, and what Open3D's recorders write."""

import re
from pathlib import Path

from ljn.reading import brief
from ljn.system.readers.files import (
    CameraLike,
    Entry,
    FileRecording,
    find_cameras,
    find_depth_images,
    find_rgb_images,
    natural_key,
)
from ljn.system.readers.timestamps import read_timestamps
from ljn.system.readers.video import VIDEO_SUFFIXES, Video

LOOKS_FOR = (
    "depth/ (PNG of 16 bits, .npy or .npz) with rgb/ or color/ (PNG or JPEG) or a video rgb.mp4, .avi or .mkv, and "
    "camera.yaml (or Open3D's camera_intrinsic.json or intrinsic.json)"
)
_TIMES = ("timestamps.csv", "timestamps.txt")
_LAST_NUMBER = re.compile(r"(\d+)\D*$")
_MOST_UNPAIRED = 5, 0.2  # of a video's frames and the depth images: by number and by share


def is_folder(path: Path) -> bool:
    """Whether it has this layout."""
    return (path / "depth").is_dir()


def open_folder(
    path: Path,
    camera: CameraLike | None = None,
    rgb_camera: CameraLike | None = None,
    depth_scale: float | None = None,
) -> FileRecording:
    """A recording of `depth/` and `rgb/`, `color/` or a video; see `ljn.system.readers.open_recording`."""
    cameras = find_cameras(path, camera, rgb_camera, depth_scale)
    depths = find_depth_images(path / "depth")
    if not depths:
        raise FileNotFoundError(
            f"input: no depth image in '{path / 'depth'}': expected PNG of 16 bits, .npy or .npz"
        )
    facts: dict[str, object] = {}
    pictures = next((path / name for name in ("rgb", "color") if (path / name).is_dir()), None)
    names = (f"{stem}{suffix}" for stem in ("rgb", "color") for suffix in VIDEO_SUFFIXES)
    video = next((path / name for name in names if (path / name).is_file()), None)
    fps = None
    if pictures is not None:
        entries, layout = _with_pictures(depths, pictures, facts), f"depth and {pictures.name} images"
    elif video is not None:
        with Video(video) as opened:
            fps, num_frames = opened.fps, opened.num_frames
        entries, layout = _with_video(depths, video, num_frames, facts), f"depth images and {video.name}"
    else:
        entries, layout = [Entry(name, depth) for name, depth in depths.items()], "depth images"
    times = next((path / name for name in _TIMES if (path / name).is_file()), None)
    if times is not None:
        seconds, remark = read_timestamps(times, [entry.name for entry in entries])
        entries = [entry._replace(time_s=time) for entry, time in zip(entries, seconds)]
        facts |= {"timestamps": remark} if remark else {}
    return FileRecording(path, layout, entries, cameras, facts, None if pictures else video, fps)


def _with_pictures(depths: dict[str, Path], folder: Path, facts: dict[str, object]) -> list[Entry]:
    """Images of one name belong together, or else those of one number; what has no partner stays alone."""
    pictures = find_rgb_images(folder)
    if not pictures:
        raise FileNotFoundError(
            f"input: no colour image in '{folder}': expected PNG or JPEG; remove the folder where there are no colours"
        )
    if not depths.keys() & pictures.keys():
        by_number = _by_number(pictures)
        numbers = {number: depth for number, depth in _by_number(depths).items() if number in by_number}
        if not numbers:
            raise ValueError(
                f"input: no image of '{folder}' has the name or the number of a depth image (such as "
                f"'{brief(next(iter(pictures)))}' and '{brief(next(iter(depths)))}'); give both the same names"
            )
        facts["matched"] = "by the last number of their names"
        pictures = {depth.stem: by_number.pop(number) for number, depth in numbers.items()}
        pictures |= {picture.stem: picture for picture in by_number.values()}
    # Frames without depth come in their order, too.
    names = sorted(depths.keys() | pictures.keys(), key=natural_key)
    return [Entry(name, depths.get(name), pictures.get(name)) for name in names]


def _by_number(images: dict[str, Path]) -> dict[int, Path]:
    """The images by the last number of their names; none where two share one."""
    found = {int(number[1]): path for stem, path in images.items() if (number := _LAST_NUMBER.search(stem))}
    return found if len(found) == len(images) else {}


def _with_video(
    depths: dict[str, Path], video: Path, num_frames: int, facts: dict[str, object]
) -> list[Entry]:
    """The video's frames belong to the depth images in their order."""
    unpaired = abs(num_frames - len(depths))
    if unpaired > max(_MOST_UNPAIRED[0], _MOST_UNPAIRED[1] * len(depths)):
        raise ValueError(
            f"input: '{video}' has {num_frames} frames beside {len(depths)} depth images, so they were not taken "
            "together, one by one; cut them to the same length and frames a second, or save the colours in rgb/, "
            "with the depth images' names"
        )
    if num_frames > len(depths):
        facts["colours_without_depth"] = unpaired
    return [
        Entry(name, depth, number if number < num_frames else None)
        for number, (name, depth) in enumerate(depths.items())
    ]
