"""SURREAL's files held against themselves: joints through its camera, poses through the bodies that are loaded."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from datamodules.sources.surreal.bodies import ClipBodies
from datamodules.sources.surreal.files import INFO, FilmedClip, read_filmed_clip
from datamodules.sources.surreal.index import ClipEntry
from datamodules.sources.surreal.world import to_mirrored_camera, to_pixels
from ljn.body import BodyModel
from ljn.data import Finding

_ROUNDING_PX = 0.5
_TOLERANCE_PX = 0.01
_NEAR_M = 1.0  # from the camera's plane: nearer, the rounding of numbers of 32 bits shows
_SAME_MM = 5.0


def examine_clips(
    tree: Path, entries: Sequence[ClipEntry], bodies: Sequence[BodyModel], num_clips: int | None
) -> Iterator[Finding]:
    """A line for each of so many clips from all over the tree, or of all, and what they say together.

    Files of which the index says that they cannot be read are counted. Two checks, each at its own place. `camera`: the
    file's 3D joints through SURREAL's camera against its 2D joints, no body taking part: by how much they differ beyond
    the rounding to whole pixels, the largest over frames and joints. `body`: the file's pose and shape through the
    loaded body against its 3D joints, mean and largest, mm; and these joints through the camera against the 2D joints,
    pixels.
    """
    readable = [entry for entry in entries if not entry.problem]
    chosen = from_all_over(readable, num_clips)
    posed = ClipBodies(bodies)
    num_damaged = 0
    camera_px: list[float] = []
    body_mm: list[float] = []
    for entry in chosen:
        try:
            clip = read_filmed_clip(tree / f"{entry.name}{INFO}")
        except (ValueError, OSError) as error:
            num_damaged += 1
            yield Finding(f"damaged: {error}", {})
            continue
        frames = np.flatnonzero(clip.is_good)
        if not len(frames):
            num_damaged += 1
            yield Finding(f"damaged: {entry.name}{INFO}: no frame of {len(clip)} is whole", {})
            continue
        errors = 1000 * posed.errors_m(clip, frames)
        camera_px.append(beyond_rounding_px(clip, frames, clip.joints[frames]))
        body_mm.append(float(errors.mean()))
        body_px = beyond_rounding_px(clip, frames, posed.joints(clip, frames))
        yield Finding(
            f"{entry.name}: {len(frames)} frames; camera {camera_px[-1]:.2f} px; body mean {body_mm[-1]:.1f}, max "
            f"{errors.max():.1f} mm, {body_px:.2f} px",
            {"camera_px": camera_px[-1], "body_mm": float(errors.max()), "body_px": body_px},
        )
    num_unreadable = len(entries) - len(readable)
    yield Finding(
        f"{len(chosen)} of {len(readable)} clips, {num_damaged} of them damaged; {num_unreadable} other files cannot "
        "be read",
        {"damaged": float(num_damaged + num_unreadable)},
    )
    if camera_px:
        yield _of_bodies(body_mm, bodies)
        yield _of_camera(max(camera_px))
    else:
        yield Finding("no clip can be compared: none has all of pose, joints and camera", {}, is_wrong=True)


def from_all_over(entries: Sequence[ClipEntry], number: int | None) -> list[ClipEntry]:
    """So many of the entries, at equal distances, or all."""
    if number is None:
        return list(entries)
    return [entries[i] for i in np.unique(np.linspace(0, len(entries) - 1, number).astype(int))]


def beyond_rounding_px(clip: FilmedClip, frames: np.ndarray, joints: np.ndarray) -> float:
    """The largest distance along u or v between joints `(n, 24, 3)` in the image and the file's, less that of rounding.

    Joints are in SURREAL's world, metres; people walk past its camera. Those within 1 m of the camera's plane are not
    compared; infinite if that is all of them.
    """
    seen = to_mirrored_camera(joints, clip.camera_place)
    is_compared = np.abs(seen[..., 2]) > _NEAR_M
    if not is_compared.any():
        return float("inf")
    error = np.abs(to_pixels(seen[is_compared]) - clip.pixels[frames][is_compared]).max() - _ROUNDING_PX
    return float(max(0.0, error))


def _of_bodies(body_mm: Sequence[float], bodies: Sequence[BodyModel]) -> Finding:
    error = float(np.median(body_mm))
    genders = ", ".join(body.gender for body in bodies)
    words = (
        f"the joints of the loaded bodies ({genders}) lie {error:.1f} mm from the files', median over clips"
    )
    if error < _SAME_MM:
        return Finding(f"bodies: {words}: SURREAL was made with these", {})
    return Finding(
        f"bodies: {words}: SURREAL was made with others, so that the numbers of the body say how these differ and "
        "nothing of the files; to check pose and shape, too, give the official SMPL bodies, female and male: body=smpl "
        "body.path=FOLDER",
        {},
    )


def _of_camera(error_px: float) -> Finding:
    if error_px <= _TOLERANCE_PX:
        return Finding("camera: 3D joints fall on the 2D joints, 0 px beyond rounding: all is well", {})
    return Finding(
        f"camera: joints3D fall {error_px:.2f} px beyond rounding from joints2D, expected 0: joints3D, joints2D or "
        "camLoc are not SURREAL's own (turned back, shifted, of another image size?); take the files as they "
        "were downloaded",
        {},
        is_wrong=True,
    )
