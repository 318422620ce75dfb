"""The person's pixels in a frame of colour and depth, before a green curtain (thesis, section 4.1)."""

from typing import NamedTuple

import cv2
import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.depth import AREA_M2
from ljn.pipeline.person import Person, find_person
from ljn.system.floor import find_floor, heights_m, rays, tolerance_m
from ljn.system.recording import RgbdFrame

_GREENER = 0.06
"""By this share of a pixel's brightness its green exceeds red and blue, where it may be the curtain's."""
_DARKEST = 60
"""The least sum of a colour's channels, of 765, that says anything of its hue."""
_LEAST_GREEN = 0.04
_LIKE, _OFF = 0.62, 0.35
"""A pixel is the curtain's where it is at least this far on the way from grey to the curtain's colour, and no farther
from that way than the second, as shares of the way."""
_BEFORE_M = 0.12
"""The curtain's folds reach no farther forward."""
_BAND_PX, _WIDE_PX, _AROUND_PX = 2, 6, 11
"""Reach of the band in which colours decide, where depth is measured and where it is not; and of their means."""

_BY_DEPTH, _SHARE = 1.0, 0.4
"""A border pixel is the person's where the share of the person's colour in it, and the first times the share of its
neighbours that are the person's by depth, less a half, exceed the second."""
_CONTRAST = 40.0
"""Colours that differ by less, of 255 in each channel, do not say where the person ends: depth does."""
_SMALLEST_LOST, _LARGEST_LOST, _LEAST_GREEN_RIM = 20, 0.25, 0.5
"""A piece without depth that touches the person is its own if it has more pixels than the first, fewer than the second
as a share of the person's, and green around it, where the person is not, along the third of its outline."""
_RING_PX, _LEAST_RING = 12, 0.35
_MOST_GREEN = 0.15
_OTHER_M2, _OTHER_M = 0.15, 0.9
"""What is larger and higher than this is a second person."""


class Green(NamedTuple):
    """A curtain's colour.

    Attributes:
        direction: `(2,)` float32, from grey to its chromaticity (shares of red and green in a colour).
        share: Share of the image that is so coloured.
    """

    direction: np.ndarray
    share: float


class GreenCurtain:
    """Finds a person before a green curtain: by depth first, at the border by colour.

    The curtain's colour is estimated from each image, so curtains and lights may differ, and vary over the image. Its
    surface is fitted to the depth of what has that colour, and the floor is found; what stands before the curtain and
    on the floor, and hangs together in space, is the person. In a band of some pixels along its outline, where a depth
    image is ragged, each pixel is then asked whether its colour is nearer to that of the person or of what is behind,
    as both are around it: so the curtain's light on hair and skin does not count as curtain.

    The person may reach beyond the curtain's edges, and the curtain may go on over the floor.

    Attributes:
        facts: What was found in the last frame: `green` (share of the image), `curtain_m` (its depth behind the person,
            where it was measured), `has_floor`, `area_m2`.
    """

    def __init__(self) -> None:
        self.facts: dict[str, object] = {}

    def __call__(self, frame: RgbdFrame, camera: Camera) -> np.ndarray:
        """The person's pixels.

        Args:
            frame: The frame, with colours.
            camera: Its camera.

        Returns:
            `(H, W)` bool.

        Raises:
            ValueError: The frame has no depth or no colours, the curtain is not there or not green, there is no person
                or more than one, or the person's clothes are green.
        """
        self.facts = {}
        depth, rgb = _images(frame, camera)
        green, shares = find_green(rgb)
        is_green = _has_colour(shares, green)
        is_known = _brightest(rgb) > 0
        self.facts["green"] = round(green.share, 3)
        curtain = _curtain_depth(depth, is_green, camera)
        is_before = depth > 0
        if curtain is not None:
            is_before &= depth < curtain - _BEFORE_M
        floor = find_floor(np.where(is_before, depth, np.float32(0)), camera)
        is_floor = np.zeros(depth.shape, bool)
        if floor is not None:
            heights, tolerance = heights_m(depth, camera, floor), tolerance_m(depth)
            is_floor = is_before & (np.abs(heights) < tolerance)
            is_before &= heights > tolerance
        self.facts["has_floor"] = floor is not None
        try:
            person = one_person(np.where(is_before, depth, np.float32(0)), camera)
        except ValueError as error:
            where = "" if curtain is None else f", {np.median(curtain):.1f} m away"
            raise ValueError(
                f"{error}; taken for the curtain: the {100 * green.share:.0f} % of the image that are green{where}"
            ) from error
        is_person = person.depth > 0
        self.facts["area_m2"] = round(person.area_m2, 3)
        if curtain is not None:
            self.facts["curtain_m"] = round(float(np.median(curtain[is_person])), 3)
        _check_colours(is_person, is_green, is_known)
        is_lost = (depth == 0) & ~is_green
        is_person |= _not_measured(is_person, is_lost & is_known, is_green)
        is_lost |= is_floor
        return _refined(is_person, is_lost, is_green & ~is_before, is_known, rgb)


def _images(frame: RgbdFrame, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    if frame.error is not None or frame.depth is None:
        raise ValueError(f"frame: expected a depth image, got none ({frame.error or 'nothing was read'})")
    if frame.rgb is None:
        raise ValueError(
            "frame: expected colours, got none; a green curtain is found by its colour: segmentation=depth_only does "
            "without"
        )
    for name, image in (("depth", frame.depth), ("rgb", frame.rgb)):
        if image.shape[:2] != (camera.height, camera.width):
            raise ValueError(
                f"frame.{name}: expected the camera's {camera.width} x {camera.height} (width x height) pixels, got "
                f"{image.shape[1]} x {image.shape[0]}; register colours to the depth image"
            )
    return frame.depth, frame.rgb


def _brightest(rgb: np.ndarray) -> np.ndarray:
    red, green, blue = cv2.split(rgb)
    return cv2.max(cv2.max(red, green), blue)


def find_green(rgb: np.ndarray) -> tuple[Green, tuple[np.ndarray, np.ndarray]]:
    """The curtain's colour in an image, and the chromaticity of its pixels.

    Args:
        rgb: `(H, W, 3)` uint8.

    Returns:
        The colour; and twice `(H, W)` float32, the shares of red and of green in each pixel's colour, less a third.

    Raises:
        ValueError: Hardly anything is green.
    """
    red, green, blue = cv2.split(cv2.GaussianBlur(rgb, (3, 3), 0))
    total = cv2.add(cv2.add(red, green, dtype=cv2.CV_32F), blue, dtype=cv2.CV_32F)
    excess = cv2.subtract(green, cv2.max(red, blue))  # of bytes: 0 where there is none
    is_seed = (excess > _GREENER * total) & (total > _DARKEST)
    share = float(np.count_nonzero(is_seed)) / is_seed.size
    if share < _LEAST_GREEN:
        raise ValueError(
            f"frame.rgb: expected a green curtain behind the person, got {100 * share:.1f} % of the image that is "
            f"green, less than {100 * _LEAST_GREEN:.0f} %; is the curtain there, and lit? segmentation=depth_only does "
            "without one"
        )
    of_red, of_green = (
        cv2.divide(each, total, dtype=cv2.CV_32F) - np.float32(1 / 3) for each in (red, green)
    )
    step = max(1, np.count_nonzero(is_seed) // 5000)
    direction = [np.median(each[is_seed][::step]) for each in (of_red, of_green)]
    return Green(np.array(direction, np.float32), share), (of_red, of_green)


def _has_colour(shares: tuple[np.ndarray, np.ndarray], green: Green) -> np.ndarray:
    """Whether pixels have the curtain's colour, `(H, W)` bool; `shares` as of `find_green`."""
    length = float(np.linalg.norm(green.direction))
    unit = green.direction / length
    along = shares[0] * unit[0] + shares[1] * unit[1]
    aside = shares[1] * unit[0] - shares[0] * unit[1]
    return (along > _LIKE * length) & (np.abs(aside) < _OFF * length)


def _curtain_depth(depth: np.ndarray, is_green: np.ndarray, camera: Camera) -> np.ndarray | None:
    """Depth `(H, W)` of the plane that the curtain hangs in, metres; None where too little of it was measured."""
    rows, columns = np.nonzero(is_green[::2, ::2] & (depth[::2, ::2] > 0))
    if 4 * len(rows) < 0.3 * np.count_nonzero(is_green):
        return None
    step = max(1, len(rows) // 3000)
    v, u = 2 * rows[::step], 2 * columns[::step]
    z = depth[v, u].astype(np.float64)
    far = np.percentile(z, 60)
    is_on = np.abs(z - far) < 0.5  # not a green floor, nor what is green before the curtain
    across, down = rays(camera)
    terms = np.stack([across[0, u], down[v, 0], np.ones(len(u))], -1)  # of a plane 1 / z is linear in these
    plane = np.array([0.0, 0.0, 1 / far])
    for _ in range(3):
        if np.count_nonzero(is_on) < 50:
            return None
        plane = np.linalg.lstsq(terms[is_on], 1 / z[is_on], rcond=None)[0]
        is_on = np.abs(1 / np.maximum(terms @ plane, 1e-3) - z) < _BEFORE_M
    inverse = np.float32(plane[0]) * across + (np.float32(plane[1]) * down + np.float32(plane[2]))
    return 1 / np.maximum(inverse, np.float32(0.05))


def nobody(reason: str) -> str:
    """What is said where there is no person."""
    return f"frame.depth: expected a person, found nobody: {reason}"


def one_person(metres: np.ndarray, camera: Camera) -> Person:
    """The only person in a depth image `(H, W)` of what is before curtain, walls and floor, metres; 0 is nothing.

    Raises:
        ValueError: There is nobody, or more than one.
    """
    if not metres.any():
        raise ValueError(nobody("nothing stands before the background"))
    person = find_person(metres, camera)
    if person.area_m2 < AREA_M2[0]:
        raise ValueError(
            nobody(
                f"the largest thing before the background measures {person.area_m2:.2f} square metres, less than "
                f"{AREA_M2[0]:g}"
            )
        )
    if person.area_m2 > AREA_M2[1]:
        raise ValueError(
            f"frame.depth: expected one person, what stands before the background measures {person.area_m2:.1f} square "
            f"metres, more than {AREA_M2[1]:g}: several persons? Or is the depth in another unit (depth_scale in "
            "camera.yaml), or the camera another one's?"
        )
    if person.foreign_m2 > _OTHER_M2:
        other = find_person(np.where(person.depth > 0, np.float32(0), metres), camera)
        rows = np.flatnonzero(other.depth.any(1))
        z = float(np.median(other.depth[other.depth > 0]))
        if other.area_m2 > _OTHER_M2 and (rows[-1] - rows[0]) * z / camera.fy > _OTHER_M:
            raise ValueError(
                "frame.depth: expected one person, several persons stand before the background, or something of a "
                "person's size; let one alone stand there"
            )
    return person


def _share(chosen: np.ndarray, among: np.ndarray) -> float:
    return float(np.count_nonzero(chosen & among)) / max(1, int(np.count_nonzero(among)))


def _check_colours(is_person: np.ndarray, is_green: np.ndarray, is_known: np.ndarray) -> None:
    inside = cv2.erode(is_person.astype(np.uint8), _disc(3)) > 0
    inside &= is_known
    green = _share(is_green, inside)
    if green > _MOST_GREEN:
        raise ValueError(
            f"frame.rgb: the person's clothes are green: {100 * green:.0f} % of the person has the curtain's colour; "
            "wear other ones, or take segmentation=depth_only"
        )
    person = is_person.astype(np.uint8)
    ring = (cv2.dilate(person, _disc(_RING_PX)) > cv2.dilate(person, _disc(4))) & is_known
    rows = np.flatnonzero(is_person.any(1))
    ring[rows[0] + int(0.8 * (rows[-1] - rows[0])) :] = False  # the floor
    around = _share(is_green, ring)
    if around < _LEAST_RING:
        raise ValueError(
            f"frame.rgb: expected a green curtain behind the person, got {100 * around:.0f} % green around it; is the "
            "curtain large enough, and green? segmentation=depth_only does without one"
        )


def _not_measured(is_person: np.ndarray, is_lost: np.ndarray, is_green: np.ndarray) -> np.ndarray:
    """Hair and dark cloth that no depth was measured of: what is not green beside the person, before the curtain.

    Args:
        is_person: `(H, W)` bool, by depth.
        is_lost: `(H, W)` bool, pixels without depth that are not green.
        is_green: `(H, W)` bool.

    Returns:
        `(H, W)` bool.
    """
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(is_lost.astype(np.uint8), connectivity=4)
    most = _LARGEST_LOST * np.count_nonzero(is_person)
    found = np.zeros(is_person.shape, bool)
    for number in np.flatnonzero((boxes[:, 4] > _SMALLEST_LOST) & (boxes[:, 4] < most)):
        left, top, width, height = boxes[number, :4]
        box = slice(max(0, top - 4), top + height + 4), slice(max(0, left - 4), left + width + 4)
        is_piece = labels[box] == number
        around = (cv2.dilate(is_piece.astype(np.uint8), _disc(3)) > 0) & ~is_piece
        if (around & is_person[box]).any() and _share(
            is_green[box], around & ~is_person[box]
        ) > _LEAST_GREEN_RIM:
            found[box] |= is_piece
    return found


def _refined(
    is_person: np.ndarray, is_lost: np.ndarray, is_curtain: np.ndarray, is_known: np.ndarray, rgb: np.ndarray
) -> np.ndarray:
    """The person with its outline where colours and depth together put it.

    Args:
        is_person: `(H, W)` bool, by depth.
        is_lost: `(H, W)` bool, where depth does not say: hair and dark cloth, and soles that are too near the floor.
        is_curtain: `(H, W)` bool.
        is_known: `(H, W)` bool, where the colour is known.
        rgb: `(H, W, 3)` uint8.

    Returns:
        `(H, W)` bool.
    """
    rows, columns = np.flatnonzero(is_person.any(1)), np.flatnonzero(is_person.any(0))
    low = np.maximum([rows[0] - 2 * _AROUND_PX, columns[0] - 2 * _AROUND_PX], 0)
    window = slice(low[0], rows[-1] + 2 * _AROUND_PX), slice(low[1], columns[-1] + 2 * _AROUND_PX)
    person, colours = is_person[window].astype(np.uint8), rgb[window].astype(np.float32)
    sure = cv2.erode(person, _disc(_BAND_PX))
    grown = cv2.dilate(person, _disc(_BAND_PX)) | (is_lost[window] & cv2.dilate(person, _disc(_WIDE_PX)))
    inner, outer = (sure > 0) & ~is_curtain[window], (grown == 0) & is_known[window]
    near, behind = _mean(colours, inner), _mean(colours, outer)
    towards = near - behind
    contrast = np.einsum("vuc,vuc->vu", towards, towards)
    share = np.einsum("vuc,vuc->vu", colours - behind, towards) / np.maximum(contrast, 1)
    by_depth = cv2.blur(person.astype(np.float32), (3, 3)) - 0.5
    # Neither is known everywhere: NaN is not clear.
    is_clear = (grown > sure) & is_known[window] & (contrast > _CONTRAST**2)
    mask = np.where(is_clear, share + _BY_DEPTH * by_depth > _SHARE, person > 0)
    mask = cv2.medianBlur(mask.astype(np.uint8), 3)
    number, labels = cv2.connectedComponents(mask, connectivity=8)
    is_kept = np.zeros(number, bool)
    is_kept[labels[sure > 0]] = True
    is_kept[0] = False
    result = np.zeros(is_person.shape, bool)
    result[window] = is_kept[labels]
    return result


def _mean(colours: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The mean colour `(h, w, 3)` of what is chosen `(h, w)` around each pixel; NaN where nothing is."""
    size = (_AROUND_PX, _AROUND_PX)
    sums = cv2.boxFilter(cv2.copyTo(colours, chosen.astype(np.uint8)), -1, size, normalize=False)
    counts = cv2.boxFilter(chosen.astype(np.float32), -1, size, normalize=False)
    return sums / np.where(counts > 0.5, counts, np.float32(np.nan))[..., None]


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
