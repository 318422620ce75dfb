"""Recordings of depth cameras in files, and cameras that record now, behind one interface."""

from pathlib import Path

from ljn.system.readers import folder, tum
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import CameraLike, FileRecording
from ljn.system.readers.live import LiveRecording, open_live
from ljn.system.readers.recorder import Recorder
from ljn.system.recording import Recording

__all__ = ["LensCamera", "Recorder", "open_recording"]

_LAYOUTS = (
    (tum.is_tum, tum.open_tum, tum.LOOKS_FOR),
    (folder.is_folder, folder.open_folder, folder.LOOKS_FOR),
)


def open_recording(
    path: str | Path,
    camera: CameraLike | None = None,
    rgb_camera: CameraLike | None = None,
    depth_scale: float | None = None,
) -> Recording:
    """A recording, whose layout is recognised by what is there, or a camera that records now.

    Args:
        path: Its folder; a RealSense camera's `.bag` or `.db3`; `live:realsense`, `live:azure` or `live:kinect2`; or
            `live:replay:PATH`, a recording's frames as they would come from a camera.
        camera: The depth camera, or its file; None for that in the folder.
        rgb_camera: The colour camera, or its file; None for that in the folder, or for colours that are registered to
            the depth images already, pixel by pixel.
        depth_scale: Units of integer depth images to a metre; None for what the layout says: 5000 in TUM's, otherwise
            1000, millimetres.

    Raises:
        ImportError: The driver of the camera or the file is missing.
        RuntimeError: The camera cannot be opened.
        FileNotFoundError: There is no such folder, no images in it, or no camera file.
        ValueError: It has no layout that is known, files cannot be read, or images and cameras do not fit each other.
    """
    if str(path).startswith("live:"):
        source = str(path).removeprefix("live:")
        if not source.startswith("replay:") and (camera or rgb_camera or depth_scale):
            raise ValueError(
                "camera: a live camera says itself what it is; leave out camera, rgb_camera, depth_scale"
            )
        return open_live(source, lambda files: _open_files(files, camera, rgb_camera, depth_scale))
    if Path(path).suffix in (".bag", ".db3") and Path(path).is_file():
        from ljn.system.readers.realsense import RealSense

        return LiveRecording(RealSense(Path(path)))
    return _open_files(Path(path), camera, rgb_camera, depth_scale)


def _open_files(
    path: Path, camera: CameraLike | None, rgb_camera: CameraLike | None, depth_scale: float | None
) -> FileRecording:
    if not path.exists():
        raise FileNotFoundError(f"input: no folder '{path}'")
    for is_layout, open_layout, _ in _LAYOUTS:
        if path.is_dir() and is_layout(path):
            return open_layout(path, camera, rgb_camera, depth_scale)
    sought = "; or ".join([*(text for _, _, text in _LAYOUTS), "a RealSense camera's .bag or .db3"])
    raise ValueError(f"input: '{path}' is no recording: looked for {sought}")
