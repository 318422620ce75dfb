"""2D keypoints as detectors give them, turned into those of the 24 SMPL joints; those that are missing are filled in.

`body_keypoints` also holds them against the body: of several persons or orders it finds the one that fits, and it
refuses keypoints that fit nothing there, see `ljn.pipeline.keypoint_checks`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ljn.body.skeleton import JOINT_NAMES, NUM_JOINTS
from ljn.geometry.camera import Camera
from ljn.pipeline import keypoint_checks as checks
from ljn.pipeline.filling import fill_missing
from ljn.pipeline.keypoint_files import Person, read_people
from ljn.pipeline.keypoint_orders import ORDERS, orders_of, taken_by
from ljn.pipeline.report import Report

MIN_CONFIDENCE = 0.2
"""Keypoints of a lower confidence count as missing."""
MIN_KNOWN = 8
"""Joints that must be known. From 8 of COCO's the others are filled in with a mean error of 15 px where the body is
some 300 px tall; `tests/benchmarks/keypoint_filling.py` measures this and makes the covariance."""

_OUTSIDE = 0.05  # how far beyond the image a keypoint may lie, of the image's longer side
_ONE_PLACE_M = 0.05  # keypoints whose standard deviation is less lie at one place
_FARTHEST_PX = 1e6  # beyond, one place is as wrong as another
_SHARES = 2  # keypoints that are all between 0 and this are no pixels
_PERCENT = 20  # confidences of which one is higher are in percent
_CLOSE = 0.3  # orders whose likelihoods' logs differ by less are not told apart
_PLAIN = 6.0  # an order whose likelihood's log is less than another's by this is wrong
_PLAIN_MISFIT_M = 0.16  # a person of a higher one is not the body's where another fits


class Keypoints(NamedTuple):
    """2D keypoints of the 24 SMPL joints.

    Attributes:
        positions: `(24, 2)` float32, u and v, pixels.
        confidences: `(24,)` float32, 1 where none came; 0 where a joint is filled in.
    """

    positions: np.ndarray
    confidences: np.ndarray


class _Named(NamedTuple):
    """Keypoints in one order.

    Attributes:
        order: Its name.
        positions: `(24, 2)`, NaN where not known.
        confidences: `(24,)`, 0 where not known.
        table: `(K, 2)`, its keypoints, NaN where not known.
    """

    order: str
    positions: np.ndarray
    confidences: np.ndarray
    table: np.ndarray

    @property
    def num_known(self) -> int:
        return int(np.count_nonzero(self.confidences))


class _Judged(NamedTuple):
    """Keypoints in one order, held against a body.

    Attributes:
        named: All of them.
        is_wild: `(24,)`, which of them are not to be trusted.
        fit: How well the others fit.
    """

    named: _Named
    is_wild: np.ndarray
    fit: checks.Fit

    @property
    def positions(self) -> np.ndarray:
        """`(24, 2)`, NaN where not known or not to be trusted."""
        return np.where(self.is_wild[:, None], np.nan, self.named.positions)


def smpl_keypoints(keypoints: Any, min_known: int = MIN_KNOWN) -> Keypoints:
    """The 24 SMPL joints' keypoints from any order's; `body_keypoints` also checks them on the body.

    A keypoint is missing where it is None, NaN, (0, 0) or both its numbers are negative, or its confidence is under
    `MIN_CONFIDENCE`. Confidences are shares, in percent or COCO's visibility (0, 1, 2), as their values tell.

    Args:
        keypoints: `[u, v]` or `[u, v, confidence]`, pixels, of each keypoint of an order of `ORDERS` (of those of one
            length, the first), also one after another; a mapping from an order's names to such entries;
            `{"order": name, "keypoints": entries}`, also with `keypoint_scores`; or what OpenPose, MMPose, ultralytics
            or MediaPipe write, COCO's annotations or results, with one person.
        min_known: The fewest joints that have to be known.

    Raises:
        ValueError: Not one of these, or fewer joints are known.
    """
    people = read_people(keypoints)
    if len(people) > 1:
        raise ValueError(f"keypoints: expected one person, got {len(people)}; {_CHOOSE}")
    person = _sure(people[0], Report())
    named = _named(person, person.orders[0])
    if named.num_known < min_known:
        raise ValueError(_too_few(named, min_known))
    return _filled(named)


def body_keypoints(
    keypoints: Any,
    depth: np.ndarray,
    camera: Camera,
    min_known: int = MIN_KNOWN,
    report: Report | None = None,
) -> Keypoints:
    """The 24 SMPL joints' keypoints from any order's, checked on the body.

    Of several persons the one that alone fits the body is taken, of several orders of one length the one that fits
    plainly better. Single keypoints far from where all others expect them count as missing.

    Args:
        keypoints: See `smpl_keypoints`; several persons, and MediaPipe's shares of the image's size, are taken, too.
        depth: `(H, W)`, metres, of the body alone; 0 elsewhere.
        camera: The camera of this image.
        min_known: The fewest joints that have to be known.
        report: Takes the order, what is known, filled in and mistrusted, and doubts.

    Raises:
        ValueError: They are not one of these, fewer joints are known, or they do not fit the body; the message then
            names the reading that would, if any does.
    """
    report = Report() if report is None else report
    people = read_people(keypoints)
    body = checks.seen_body(depth, camera)
    if len(people) > 1:
        person, number = _only_fitting(people, body, min_known)
        report.note(keypoint_persons=len(people), keypoint_person=number)
    else:
        (person,) = people
    person = _sure(_in_pixels(person, camera, report), report)
    judged = _in_order(person, body, min_known)
    named, is_wild, fit = judged
    if is_wild.any():
        report.doubt(
            f"keypoints: {', '.join(checks.named(is_wild))} lie far from where the others expect them and count as "
            "missing; set wrong keypoints to null"
        )
    _check_fit(judged, body, person, report)
    kept = named._replace(positions=judged.positions, confidences=np.where(is_wild, 0, named.confidences))
    report.note(
        keypoint_order=named.order,
        keypoint_form=person.form,
        keypoints_known=kept.num_known,
        keypoints_filled=NUM_JOINTS - kept.num_known,
        keypoints_mistrusted=checks.named(is_wild),
        keypoint_misfit_m=round(fit.misfit_m, 3),
    )
    return _filled(kept)


def _filled(named: _Named) -> Keypoints:
    return Keypoints(fill_missing(named.positions).astype(np.float32), named.confidences.astype(np.float32))


_CHOOSE = "keep the one that the depth image shows"


def _only_fitting(people: Sequence[Person], body: checks.Body, min_known: int) -> tuple[Person, int]:
    """The only person who fits the body, and its number from 0."""
    fitting, last_error = [], ""
    for number, person in enumerate(people):
        try:
            scaled = _sure(_in_pixels(person, body.camera, Report()), Report())
            fit = _in_order(scaled, body, min_known).fit
        except ValueError as error:
            last_error = f" (the last of the others: {error})"
            continue
        if fit.misfit_m <= _PLAIN_MISFIT_M and not fit.is_impossible and not fit.is_few:
            fitting.append((person, number))
    if len(fitting) == 1:
        return fitting[0]
    raise ValueError(
        f"keypoints: expected one person, got {len(people)}, of whom {len(fitting)} fit the body{last_error}; {_CHOOSE}"
    )


def _in_order(person: Person, body: checks.Body, min_known: int) -> _Judged:
    """The keypoints in the order that is likeliest on the body, and how well they fit."""
    read = {order: _named(person, order) for order in orders_of(len(person.table))}
    order, *others = person.orders
    if len(read) == 1:
        return _judged(read[order], body, min_known)
    likely = {order: checks.likeness(named.table, order, body) for order, named in read.items()}
    first, second = sorted(read, key=likely.__getitem__, reverse=True)[:2]
    judged = _judged(read[first if others else order], body, min_known)
    if others and likely[first] - likely[second] < _CLOSE and not judged.fit.is_impossible:
        raise ValueError(
            f"keypoints: {len(person.table)} of them may be {first} ({ORDERS[first].title}) or {second} "
            f"({ORDERS[second].title}), which fit the body about equally; say which: "
            f'{{"order": "{first}", "keypoints": [...]}}'
        )
    if not others and likely[first] - likely[order] > _PLAIN:
        other = checks.fit(read[first].positions, body)
        if not other.is_doubtful:
            raise ValueError(
                f"keypoints: in the order {order} ({ORDERS[order].title}) they do not fit the body; in the order "
                f'{first} ({ORDERS[first].title}) they would: {other}; give {{"order": "{first}", "keypoints": [...]}}'
            )
    return judged


def _judged(named: _Named, body: checks.Body, min_known: int) -> _Judged:
    if named.num_known < max(min_known, 1):
        raise ValueError(_too_few(named, min_known))
    fit, is_wild = checks.fit_without_wild(named.positions, body)
    return _Judged(named, is_wild, fit)


def _check_fit(judged: _Judged, body: checks.Body, person: Person, report: Report) -> None:
    """Raise a `ValueError` if keypoints do not fit the body, or another reading fits plainly better."""
    _check_inside(judged, body.camera)
    named, _, fit = judged
    is_refused = fit.is_impossible
    if not (is_refused or checks.is_suspicious(fit)):
        return
    better = None
    if is_refused or not fit.is_explained:
        better = checks.better_reading(judged.positions, body, is_refused)
    if is_refused:
        better = better or _all_confident(person, named, body)
    is_better = better is not None and better[1].misfit_m < fit.misfit_m - checks.BETTER_M
    if is_refused or is_better:
        would = (
            f"{_at_one_place(judged.positions, body)}no other reading was found that does; are they of another "
            f"image or person, or in another order? Known are {', '.join(ORDERS)}"
            if better is None
            else f"{better[0]} they would: {better[1]}"
        )
        raise ValueError(f"keypoints: as {named.order} they do not fit the body ({fit}); {would}")
    if fit.is_doubtful:
        report.doubt(
            f"keypoints: as {named.order} they hardly fit the body ({fit}); look at the picture of the prediction, and "
            "give those of this image and person"
        )


def _at_one_place(positions: np.ndarray, body: checks.Body) -> str:
    places = body.places(positions[np.isfinite(positions[:, 0])])
    is_one = len(places) > 2 and np.linalg.norm(places.std(0)) < _ONE_PLACE_M
    return "they all lie at one place; " if is_one else ""


def _all_confident(person: Person, named: _Named, body: checks.Body) -> tuple[str, checks.Fit] | None:
    """The reading without confidences, where that fits."""
    sure = person._replace(table=np.concatenate([person.table[:, :2], np.ones((len(person.table), 1))], 1))
    read = _named(sure, named.order)
    found = checks.fit(read.positions, body)
    if read.num_known == named.num_known or found.is_doubtful:
        return None
    return "with the third numbers ignored, which are no confidences,", found


def _check_inside(judged: _Judged, camera: Camera) -> None:
    """Raise a `ValueError` unless known keypoints lie in the image."""
    positions = judged.positions
    is_known = np.isfinite(positions[:, 0])
    known, size = positions[is_known], np.array([camera.width, camera.height])
    reach = _OUTSIDE * size.max()
    is_outside = ((known < -reach) | (known > size - 1 + reach)).any(1)
    if is_outside.any() and not judged.fit.is_impossible:
        joint = np.flatnonzero(is_known)[is_outside][0]
        u, v = positions[joint]
        raise ValueError(
            f"keypoints: {np.count_nonzero(is_outside)} of {len(known)} lie outside the image of {camera.width} x "
            f"{camera.height} (width x height) pixels, the first is {JOINT_NAMES[joint]} at ({u:.0f}, {v:.0f}); are "
            "they of an image of another size? Set those that are not seen to NaN"
        )


def _in_pixels(person: Person, camera: Camera, report: Report) -> Person:
    """MediaPipe's shares of the image's size as pixels; all others as they are, if they are pixels."""
    places = person.table[:, :2]
    given = places[np.isfinite(places).all(1) & places.any(1)]
    if not len(given) or (np.abs(given) > _SHARES).any():
        return person
    if person.orders != ("mediapipe33",):
        raise ValueError(
            f"keypoints: expected pixels, but all lie between 0 and {_SHARES}; if they are shares of the image's size, "
            f"multiply u by {camera.width} and v by {camera.height}"
        )
    report.note(keypoint_units="shares of the image's size")
    pixels = places * [camera.width, camera.height]
    return person._replace(table=np.concatenate([pixels, person.table[:, 2:]], 1))


def _sure(person: Person, report: Report) -> Person:
    """The keypoints with confidences from 0 to 1 as the third numbers."""
    confidences = _confidences(person.table[:, 2], person.orders[0], report)
    return person._replace(table=np.concatenate([person.table[:, :2], confidences[:, None]], 1))


def _named(person: Person, order: str) -> _Named:
    """A person's keypoints in an order of their length."""
    places, confidences = person.table[:, :2], person.table[:, 2]
    places = places.clip(-_FARTHEST_PX, _FARTHEST_PX)
    with np.errstate(invalid="ignore"):
        is_known = np.isfinite(places).all(1) & places.any(1) & ~(places < 0).all(1)
    is_known &= confidences >= MIN_CONFIDENCE
    members = taken_by(order) * is_known
    number = members.sum(1)
    with np.errstate(invalid="ignore"):  # NaN where none is known
        positions = members @ np.where(is_known[:, None], places, 0) / number[:, None]
    lowest = np.where(members > 0, confidences, np.inf).min(1)
    known = np.where(is_known[:, None], places, np.nan)
    return _Named(order, positions, np.where(number > 0, lowest, 0), known)


def _confidences(given: np.ndarray, order: str, report: Report) -> np.ndarray:
    """Third numbers `(K,)` as confidences from 0 to 1, as their values tell; NaN, where none came, is 1."""
    is_given = np.isfinite(given)
    values = given[is_given]
    highest = values.max(initial=0.0)
    made = np.ones(len(given))
    if not is_given.any() or highest <= 1:
        made[is_given] = values.clip(0)
        return made
    is_whole = (values == values.round()).all()
    if highest > 100:
        raise ValueError(
            f"keypoints: expected confidences as the third numbers, from 0 to 1, in percent or COCO's 0, 1 and 2, got "
            f"{highest:g}; leave them out, if they are something else"
        )
    if is_whole and highest == 2:
        report.note(keypoint_confidences="visibility: 0, 1 or 2")
        made[is_given] = values > 0
    elif is_whole and highest == 3 and order == "azure32":
        report.note(keypoint_confidences="Azure Kinect's levels, 0 to 3")
        made[is_given] = values.clip(0) / 3
    elif highest > _PERCENT:
        report.note(keypoint_confidences="percent")
        made[is_given] = values.clip(0) / 100
    else:
        report.note(keypoint_confidences="unclear: taken as they are, up to 1")
        if highest > 1.5:
            report.doubt(
                f"keypoints: confidences of up to {highest:g} are neither from 0 to 1, nor in percent, nor COCO's 0, 1 "
                "and 2; they are taken as they are, up to 1: give them from 0 to 1"
            )
        made[is_given] = values.clip(0, 1)
    return made


def _too_few(named: _Named, min_known: int) -> str:
    return (
        f"keypoints: {named.num_known} joints are known, expected at least {min_known} of the "
        f"{len(ORDERS[named.order].joints)} that {named.order} gives: keypoints that are null, NaN, (0, 0), negative "
        f"or of a confidence under {MIN_CONFIDENCE} do not count"
    )
