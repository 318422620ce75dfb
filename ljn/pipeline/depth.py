"""Depth images and masks as sensors and files give them, checked and turned into the person's own depth."""

import math
from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.person import Person, find_person, jumps_share
from ljn.pipeline.report import Report
from ljn.pipeline.scene import Misfit, find_in_scene

_FARTHEST_M = 20.0  # no depth camera sees a person farther away
_NEAREST_MM = 100.0
_INVALID_MM = 65000  # codes of sensors for "nothing measured", from here on
AREA_M2 = (0.07, 1.0)
"""Seen across the line of sight, a person has some 0.17 to 0.7 square metres, in any pose, dressed or not; what has
less than the first or more than the second is none. `python -m tests.benchmarks.input_checks` measures it."""
DOUBTFUL_M2 = 0.85
"""What has more may be one person, or two."""
REACH_M = 0.7
"""The root of the mean square of the distances of a person's points from their middle is at most this, with the arms
stretched up; what reaches farther may be two people."""
DOUBTFUL_M3 = 0.046
"""Area times reach: what has less may be a child, or somebody half hidden. The area alone would doubt who lies with the
feet towards the camera, of whom little is seen, but far."""
APART_M2 = 0.15
"""A piece of more than this that lies apart from the rest may be somebody else."""
_SPAN_M = (0.4, 2.9)  # of the longest side: from a crouching child to a tall man who reaches up
_FLAT_M = 0.03  # nobody is so flat from any side: a strip of a wall, or of a curtain
_NOISE = 0.4
"""Of neighbouring pixels; of a person's, behind any sensor, less than a quarter jump."""
_MUCH = 0.2
"""What is dropped is worth a warning from this share of the person's pixels on."""


def body_depth(
    depth: Any,
    camera: Camera,
    mask: Any = None,
    report: Report | None = None,
    misfit: Misfit | None = None,
) -> np.ndarray:
    """Depth of the person alone.

    Pixels that are NaN, infinite, negative, 0 or a sensor's code for nothing (from 65,000 on, in integers) are no
    depth. Of what the mask leaves, the largest piece that hangs together in space, and all that is near it, is the
    person (see `find_person`): a rim of the background, flying pixels and what is farther away are dropped and counted.

    Args:
        depth: `(H, W)` or `(H, W, 1)`: floating-point metres, or integer millimetres; 0 where nothing was measured.
        camera: The camera of this image.
        mask: See `person_mask`; None where depth is 0 everywhere else already, or for a person who is to be found in a
            room (see `find_in_scene`).
        report: Gets what was found and dropped.
        misfit: See `find_in_scene`.

    Returns:
        `(H, W)` float32, metres; 0 is background.

    Raises:
        ValueError: Wrong shape, unit or values; or nothing of the size of a person is left.
    """
    report = Report() if report is None else report
    depth = _squeezed(np.asarray(depth))
    _check_shape("depth", depth, camera)
    is_inside = None
    if mask is not None:
        is_inside = person_mask(mask)
        _check_shape("mask", is_inside, camera)
    _check_principal_point(camera, report)
    metres = _metres(depth, is_inside, report)
    if not metres.any():
        if is_inside is not None and _is_measured(depth).any():
            raise ValueError(
                "mask: no pixel of the mask has a depth; is it black, inverted, or of another image?"
            )
        raise ValueError(
            f"depth: all pixels are 0, or no depth ({np.count_nonzero(depth)} are negative, NaN, infinite or a "
            "code for nothing): nothing was measured; is the file or the stream the right one?"
        )
    if (share := jumps_share(metres)) > _NOISE:
        raise ValueError(
            f"depth: {100 * share:.0f} % of the neighbouring pixels lie on different surfaces, as no person does: "
            "is it noise, or are its bytes in another order, or its rows of another length?"
        )
    seen_m2 = float(np.square(metres, dtype=np.float64).sum()) / (camera.fx * camera.fy)
    is_scene = mask is None and seen_m2 > AREA_M2[1]
    person = find_in_scene(metres, camera, report, misfit) if is_scene else find_person(metres, camera)
    num_pixels = int(np.count_nonzero(person.depth))
    report.note(
        pixels=num_pixels,
        area_m2=round(person.area_m2, 3),
        dropped={
            "far": person.num_foreign,
            "rim": person.num_rim,
            "flying": person.num_flying,
        },
    )
    num_dropped = 0 if is_scene else person.num_foreign + person.num_rim + person.num_flying
    _check_size(person, camera, mask is not None, report)
    if num_dropped > _MUCH * num_pixels:
        report.doubt(
            f"depth: {num_dropped} pixels beside the person's {num_pixels} were dropped, {person.num_foreign} of them "
            f"too far from it in space to be a part of it ({person.foreign_m2:.2f} square metres) and {person.num_rim} "
            "at its rim; is somebody or something else in the mask? Give a mask of the person alone"
        )
    return person.depth


def person_mask(mask: Any, chosen: int | None = None) -> np.ndarray:
    """A mask as people have them as `(H, W)` bool, true on the person.

    Args:
        mask: `(H, W)` bool; numbers of which 0 is background and any other one number the person; a soft matte (0 to
            1, 0 to 255 or more), from half its greatest value on; an index map, with the person's number in `chosen`;
            `(H, W, 4)` with an alpha channel that is not the same everywhere, or `(H, W, 3)` or `(H, W, 1)` of these.
        chosen: Of an index map, the number of the person; of another mask, the one that counts.

    Raises:
        ValueError: It is none of these, or an index map without `chosen`.
    """
    mask = np.asarray(mask)
    if mask.ndim == 3 and mask.shape[-1] in (2, 4) and np.ptp(mask[..., -1]) > 0:
        mask = mask[..., -1]  # a cut-out: its colours say nothing
    elif mask.ndim == 3 and mask.shape[-1] in (1, 2, 3, 4):
        mask = mask[..., :3].max(-1) if mask.shape[-1] > 2 else mask[..., 0]
    if mask.dtype == bool or mask.ndim != 2:
        return mask
    if mask.dtype.kind not in "iuf":
        raise ValueError(f"mask: expected numbers or booleans, got {mask.dtype}")
    if chosen is not None:
        is_chosen = mask == chosen
        if not is_chosen.any():
            raise ValueError(f"mask: no pixel has the number {chosen}; there are {_numbers(mask)}")
        return is_chosen
    values = np.unique(mask[np.isfinite(mask)]) if mask.dtype.kind == "f" else np.unique(mask)
    others = values[values != 0]
    if len(others) <= 1:
        return mask == others[0] if len(others) else np.zeros(mask.shape, bool)
    if mask.dtype.kind != "f" and len(others) <= _MOST_NUMBERS and others[-1] < 200:
        raise ValueError(
            f"mask: expected one person, got an index map of the numbers {_numbers(mask)}; choose the person's, as in "
            f"mask == {others[0]}, or task.mask_id={others[0]}"
        )
    return mask >= values[-1] / 2


_MOST_NUMBERS = 32
"""More than these are shades of a matte, not the numbers of an index map."""


def _numbers(mask: np.ndarray) -> str:
    values, counts = np.unique(mask, return_counts=True)
    shown = [f"{value:g} ({count} pixels)" for value, count in zip(values, counts)]
    return ", ".join(shown[:8]) + (", ..." if len(shown) > 8 else "")


def _squeezed(image: np.ndarray) -> np.ndarray:
    return image[..., 0] if image.ndim == 3 and image.shape[-1] == 1 else image


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


def _check_principal_point(camera: Camera, report: Report) -> None:
    """Refuse a principal point whose coordinates are swapped, or of a larger image; doubt one far from the middle."""
    size = np.array([camera.width, camera.height])
    middle, given = (size - 1) / 2, np.array([camera.cx, camera.cy])
    as_given, swapped = (np.abs(point - middle) / size for point in (given, given[::-1]))
    shown = f"camera: cx = {camera.cx:g} and cy = {camera.cy:g} lie far from the middle of an image of {camera.width} "
    shown += f"x {camera.height} (width x height) pixels"
    if as_given.min() > 0.05 and swapped.max() < 0.025:
        raise ValueError(f"{shown}, and would lie in it if they were swapped: swap them")
    if as_given.min() > 0.4:
        raise ValueError(
            f"{shown}: is the camera that of a larger image? Scale fx, fy, cx and cy with the image"
        )
    if as_given.max() > 0.25:
        report.doubt(f"{shown}: is the camera that of this image, and not of a larger one?")


def _is_measured(depth: np.ndarray) -> np.ndarray:
    """Whether a pixel holds a depth: `(H, W)` bool."""
    if depth.dtype.kind in "iu":
        return (depth > 0) & (depth < _INVALID_MM)
    return np.isfinite(depth) & (depth > 0)


def _metres(depth: np.ndarray, is_inside: np.ndarray | None, report: Report) -> np.ndarray:
    """`(H, W)` float32, metres; 0 where nothing is measured, or outside the mask."""
    is_integer = depth.dtype.kind in "iu"
    if not is_integer and depth.dtype.kind != "f":
        raise ValueError(f"depth: expected float metres or integer millimetres, got {depth.dtype}")
    is_valid = _is_measured(depth)
    is_given = depth != 0
    if is_inside is not None:
        is_valid, is_given = is_valid & is_inside, is_given & is_inside
    num_invalid = int(np.count_nonzero(is_given & ~is_valid))
    if not is_valid.any():
        return np.zeros(depth.shape, np.float32)
    median = float(np.median(depth[is_valid]))
    if is_integer and median < _NEAREST_MM:
        raise ValueError(
            f"depth: integers are millimetres, but the median is {median:g}; metres? Give floats"
        )
    if not is_integer:
        if median > _FARTHEST_M:
            raise ValueError(
                f"depth: floats are metres, but the median is {median:g}; millimetres? Divide by 1000, or give integers"
            )
        is_far = is_valid & (depth > _FARTHEST_M)
        num_invalid += int(np.count_nonzero(is_far))
        is_valid &= ~is_far
    report.note(invalid=num_invalid)
    if num_invalid > np.count_nonzero(is_valid):
        report.doubt(
            f"depth: {num_invalid} pixels are negative, NaN, infinite or a code for nothing, more than the "
            f"{np.count_nonzero(is_valid)} with a depth; is 0 what means that nothing was measured?"
        )
    metres = np.where(is_valid, depth, 0).astype(np.float32)
    return metres / np.float32(1000) if is_integer else metres


def _check_size(person: Person, camera: Camera, is_masked: bool, report: Report) -> None:
    """Refuse what has not the size of a person."""
    area_m2 = person.area_m2
    v, u = np.nonzero(person.depth)
    z = person.depth[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    low, high = np.percentile(points, [2, 98], axis=0)  # stray pixels should not decide
    spans = high - low
    shown = (
        f"{' x '.join(f'{span:.2f}' for span in spans)} m (right, down, forward), {area_m2:.2f} square metres"
    )
    causes = (
        "is the depth in another unit than metres (float) or millimetres (integer), the camera another one's, or of an "
        "image of another size (scale fx, fy, cx and cy with it)"
    )
    if spans.max() > _SPAN_M[1] or area_m2 > AREA_M2[1]:
        fix = "does the mask show the person alone" if is_masked else "give a mask of the person; or"
        raise ValueError(
            f"depth: what is seen measures {shown}, more than a person; {fix}{', or ' if is_masked else ' '}{causes}?"
        )
    if spans.max() < _SPAN_M[0] or spans.min() < _FLAT_M or area_m2 < AREA_M2[0]:
        how = "flatter" if spans.min() < _FLAT_M else "less"
        raise ValueError(
            f"depth: what is seen measures {shown}, {how} than a person; {causes}, or is the mask wrong?"
        )
    weight = z**2  # a pixel's area grows with it
    middle = weight @ points / weight.sum()
    reach_m = math.sqrt(weight @ np.square(points - middle).sum(-1) / weight.sum())
    if area_m2 * reach_m < DOUBTFUL_M3:
        report.doubt(
            f"depth: what is seen measures {shown}, little for a person: a child, somebody half hidden, or {causes}?"
        )
    is_large = area_m2 > DOUBTFUL_M2 or reach_m > REACH_M
    apart = f"a piece of {person.apart_m2:.2f} square metres lies apart from the rest"
    if is_large and person.apart_m2 > APART_M2:
        raise ValueError(
            f"depth: what is seen measures {shown}, much for a person, and {apart}: there are two, or background is in "
            "it; give a mask of the person alone"
        )
    if is_large:
        report.doubt(
            f"depth: what is seen measures {shown}, much for a person: are there two, or is background in it? Give a "
            "mask of the person alone"
        )
    if person.apart_m2 > APART_M2:
        report.doubt(f"depth: {apart}: somebody else? Give a mask of the person alone")
