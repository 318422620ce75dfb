"""Depth images as sensors and files give them, checked and turned into the form of the training data."""

from typing import Any

import numpy as np
import torch

from ljn.geometry.camera import Camera, back_project

_FARTHEST_M = 20.0  # no depth camera sees a person farther away
_NEAREST_MM = 100.0
_BODY_SPAN_M = (0.4, 3.0)  # of its longest side: from a crouching child to a tall man who reaches up


def body_depth(depth: Any, camera: Camera, mask: Any = None) -> np.ndarray:
    """Depth of the body alone.

    Args:
        depth: `(H, W)`: floating-point metres, or integer millimetres; 0 where nothing was measured.
        camera: The camera of this image.
        mask: `(H, W)`, not 0 on the body; None where depth is 0 everywhere else already.

    Returns:
        `(H, W)` float32, metres; 0 is background.

    Raises:
        ValueError: Wrong shape, unit or values; or nothing of the size of a body is left.
    """
    depth = np.asarray(depth)
    _check_shape("depth", depth, camera)
    metres = _metres(depth)
    if mask is not None:
        mask = np.asarray(mask)
        _check_shape("mask", mask, camera)
        metres = np.where(mask != 0, metres, np.float32(0))
        if not metres.any():
            raise ValueError(
                "mask: no pixel of the mask has a depth; is it black, inverted, or of another image?"
            )
    _check_span(metres, camera, mask is not None)
    return metres


def _check_shape(name: str, image: np.ndarray, camera: Camera) -> None:
    expected = (camera.height, camera.width)
    if image.shape == expected:
        return
    fix = "give the camera of this image, or scale its fx, fy, cx, cy, width and height with the image"
    if image.shape == expected[::-1]:
        fix = (
            "the image is transposed, or the camera's width and height (and cx and cy, fx and fy) are swapped"
        )
    raise ValueError(
        f"{name}: expected the camera's {camera.height} x {camera.width} (height x width), got "
        f"{' x '.join(map(str, image.shape))}: {fix}"
    )


def _metres(depth: np.ndarray) -> np.ndarray:
    """`(H, W)` float32, metres."""
    is_integer = depth.dtype.kind in "iu"
    if not is_integer and depth.dtype.kind != "f":
        raise ValueError(f"depth: expected float metres or integer millimetres, got {depth.dtype}")
    if not is_integer and not np.isfinite(depth).all():
        raise ValueError(
            f"depth: {np.count_nonzero(~np.isfinite(depth))} pixels are NaN or infinite; set them to 0, which means "
            "that nothing was measured: np.nan_to_num(depth, posinf=0, neginf=0)"
        )
    if (depth < 0).any():
        raise ValueError(
            f"depth: {np.count_nonzero(depth < 0)} pixels are negative; depth is measured forwards, and 0 where "
            "nothing was measured"
        )
    if not depth.any():
        raise ValueError(
            "depth: all pixels are 0, nothing was measured; is the file or the stream the right one?"
        )
    median = float(np.median(depth[depth > 0]))
    if is_integer and median < _NEAREST_MM:
        raise ValueError(
            f"depth: integers are millimetres, but the median is {median:g}; metres? Give floats"
        )
    if not is_integer and median > _FARTHEST_M:
        raise ValueError(
            f"depth: floats are metres, but the median is {median:g}; millimetres? Divide by 1000, or give integers"
        )
    return depth.astype(np.float32) / np.float32(1000) if is_integer else depth.astype(np.float32)


def _check_span(metres: np.ndarray, camera: Camera, is_masked: bool) -> None:
    v, u = np.nonzero(metres)
    pixels = torch.from_numpy(np.stack([u, v], -1)).float()
    points = back_project(pixels, torch.from_numpy(metres[v, u]), camera.intrinsics()).numpy()
    # Stray pixels should not decide.
    spans = np.percentile(points, 98, axis=0) - np.percentile(points, 2, axis=0)
    shown = " x ".join(f"{span:.2f}" for span in spans)
    if spans.max() > _BODY_SPAN_M[1]:
        raise ValueError(
            f"depth: what is seen measures {shown} m (right, down, forward), more than a person; "
            + ("is" if is_masked else "give a mask of the person; or is")
            + " the depth in another unit than metres (float) or millimetres (integer), or the camera another one's?"
        )
    if spans.max() < _BODY_SPAN_M[0]:
        raise ValueError(
            f"depth: what is seen measures {shown} m (right, down, forward), less than a person; is the depth in "
            "another unit than metres (float) or millimetres (integer), the camera another one's, or the mask wrong?"
        )
