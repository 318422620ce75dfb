"""The forms in which 2D keypoints come: lists, names, and the files of detectors and of COCO; each as a table.

`read_people` only reads. Which person and which order it is, is decided where the body is known.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ljn.pipeline.keypoint_orders import KNOWN_ORDERS, ORDERS, order_of_names, orders_of
from ljn.reading import brief, reason, shown

MAX_PEOPLE = 1000
"""More are no frame's."""

_MAX_NESTING = 6
_SCORES = ("keypoint_scores", "keypoints_scores", "scores", "visible", "visibility")
_LANDMARKS = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark")
_IN_PEOPLE = ("people", "annotations", "instances", "predictions", "instance_info")
_PERSON_KEYS = {"keypoints", "pose_keypoints_2d", *_LANDMARKS, *_IN_PEOPLE}
_FOREIGN = {
    14: "LSP's", 15: "ITOP's, or OpenPose's MPI", 16: "MPII's", 20: "a Kinect v1's", 26: "Halpe's",
    133: "COCO-WholeBody's: give its first 17, which are coco17's",
}  # fmt: skip
_ENTRY = "keypoints: expected [u, v] or [u, v, confidence] for each, in pixels, or null"


class Person(NamedTuple):
    """The keypoints of one person.

    Attributes:
        table: `(K, 3)`: u, v, and the third number as it came, not yet a confidence: NaN where there was none.
        orders: The orders that they may be in, at least one.
        form: Where they come from, for reports.
    """

    table: np.ndarray
    orders: tuple[str, ...]
    form: str


def read_people(keypoints: Any) -> list[Person]:
    """The persons in keypoints of any form that `smpl_keypoints` takes; at least one.

    Raises:
        ValueError: They are of none, or of no known order, or there is no one in them.
    """
    people = _people(keypoints, None, 0)
    if not people:
        raise ValueError(
            "keypoints: expected one person, got 0: the detector found no one; leave the keypoints out, or give those "
            "of an image where it did"
        )
    return people


def _people(value: Any, order: Any, nesting: int) -> list[Person]:
    value = _listed(value)
    if nesting > _MAX_NESTING:
        raise ValueError(f"{_ENTRY} (nested too deeply)")
    if isinstance(value, Mapping):
        if value.get("order") is not None:
            order = value["order"]
            _check_order(order)
        return _people_of_mapping({key: value[key] for key in value if key != "order"}, order, nesting)
    if not _is_list(value):
        raise ValueError(f"{_ENTRY} (got {shown(value)})")
    value = [_listed(entry) for entry in value]
    if nesting and not value:
        return []
    if any(_is_number(entry) for entry in value):
        return [_person(_unflattened(value, order), order, "a flat list")]
    is_person = [_is_person(entry) for entry in value]
    if not any(is_person):
        return [_person(value, order, "a list")]
    if not all(is_person):
        raise ValueError(f"{_ENTRY}, or one person after another, got a mixture of both: {shown(value)}")
    return _several(value, order, nesting)


def _several(people: Sequence[Any], order: Any, nesting: int) -> list[Person]:
    if len(people) > MAX_PEOPLE:
        raise ValueError(f"keypoints: expected one person, got {len(people)}; keep the one of this image")
    images = {shown(one["image_id"]) for one in people if isinstance(one, Mapping) and "image_id" in one}
    if len(images) > 1:
        raise ValueError(
            f"keypoints: expected the persons of one image, got {len(people)} of {len(images)} images; keep those "
            "whose image_id is this image's"
        )
    return [person for one in people for person in _people(one, order, nesting + 1)]


def _people_of_mapping(value: Mapping[Any, Any], order: Any, nesting: int) -> list[Person]:
    if "pose_keypoints_2d" in value:
        return [_person(*_of_openpose(value, order), "OpenPose")]
    if "people" in value:
        people = _listed(value["people"])
        if not _is_list(people):
            raise ValueError(
                f"keypoints: expected one person in OpenPose's file, got {shown(people)}; keep the one that the depth "
                "image shows"
            )
        read = [_of_openpose(_listed(one), order) for one in people[: MAX_PEOPLE + 1]]
        return [_person(entries, name, "OpenPose") for entries, name in read]
    if "keypoints" in value:
        return _of_instance(value, order, nesting)
    for key in _LANDMARKS:
        if key in value:
            return _people(value[key], order or "mediapipe33", nesting + 1)
    for key in _IN_PEOPLE:
        if key in value:
            return _of_file(value[key], key, order, nesting)
    named = order_of_names(value) if order is None else _named(value, order)
    if named is None:
        raise ValueError(_unknown_names(value))
    name, entries = named
    return [_person([entries[keypoint] for keypoint in ORDERS[name].names], name, "names")]


def _of_file(people: Any, key: str, order: Any, nesting: int) -> list[Person]:
    """The persons in MMPose's and COCO's files."""
    people = _listed(people)
    if not _is_list(people):
        raise ValueError(
            f"keypoints: expected a list under '{key}', got {shown(people)}; write the file again"
        )
    if key == "instance_info" and len(people) > 1:
        raise ValueError(
            f"keypoints: expected one frame under 'instance_info' of MMPose's file, got {len(people)}; give each "
            "frame's in a file of its own"
        )
    if key == "annotations":
        people = [one for one in people if not (isinstance(one, Mapping) and one.get("num_keypoints") == 0)]
        people = [one for one in people if not isinstance(one, Mapping) or "keypoints" in one]
    return _several(people, order, nesting)


def _of_instance(value: Mapping[Any, Any], order: Any, nesting: int) -> list[Person]:
    """The persons under 'keypoints', with the scores beside them: COCO's, MMPose's, ultralytics', one's own."""
    keypoints = _listed(value["keypoints"])
    scores = next((_listed(value[key]) for key in _SCORES if value.get(key) is not None), None)
    if isinstance(keypoints, Mapping) and {"x", "y"} <= keypoints.keys():
        scores = next((_listed(keypoints[key]) for key in _SCORES if keypoints.get(key) is not None), scores)
        sides = _listed(keypoints["x"]), _listed(keypoints["y"])
        if not all(map(_is_list, sides)) or len(sides[0]) != len(sides[1]):
            raise ValueError("keypoints: expected lists of one length under 'x' and 'y', got others")
        keypoints = [list(pair) for pair in zip(*sides)]
    people = _people(keypoints, order, nesting + 1)
    if order is None and "category_id" in value:  # COCO's own
        people = [one._replace(orders=("coco17",)) if len(one.table) == 17 else one for one in people]
    if scores is None:
        return people
    if not _is_list(scores):
        raise ValueError(f"keypoints: expected a list of scores, got {shown(scores)}")
    if len(people) == 1 and len(scores) != 1:
        scores = [scores]
    tables = []
    for person, row in zip(people, scores):
        row = _listed(row)
        if len(scores) != len(people) or not _is_list(row) or len(row) != len(person.table):
            got = len(row) if _is_list(row) else shown(row)
            raise ValueError(
                f"keypoints: expected a score for each of the {len(person.table)} keypoints, got {got}; give those "
                "that are missing as 0"
            )
        column = np.array(_numbers([row], len(row))[0])
        tables.append(np.concatenate([person.table[:, :2], np.nan_to_num(column)[:, None]], 1))
    return [one._replace(table=table, form="scores beside keypoints") for one, table in zip(people, tables)]


def _of_openpose(person: Any, order: Any) -> tuple[list[Any], Any]:
    """Entries and order of one of OpenPose's persons."""
    flat = _listed(person.get("pose_keypoints_2d")) if isinstance(person, Mapping) else None
    try:
        table = np.asarray(flat, np.float64).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError) as error:
        got = "none" if flat is None else f"others ({reason(error)})"
        raise ValueError(
            "keypoints: expected u, v and confidence of each keypoint, one after another, under 'pose_keypoints_2d' of "
            f"OpenPose's person, got {got}; have OpenPose write the file again, with its model BODY_25"
        ) from error
    return table.tolist(), order or {25: "body25", 18: "coco18"}.get(len(table))


def _named(value: Mapping[Any, Any], order: Any) -> tuple[str, dict[str, Any]] | None:
    """Entries by name, in a given order."""
    found = order_of_names(value)
    entries = {} if found is None else found[1]
    given = {name: entry for name, entry in entries.items() if entry is not None}
    names = ORDERS[order].names
    return (order, {name: given.get(name) for name in names}) if given.keys() <= set(names) else None


def _unknown_names(value: Mapping[Any, Any]) -> str:
    given = set(map(str, value))
    nearest = max(ORDERS, key=lambda name: len(given & set(ORDERS[name].names)))
    unknown = brief(", ".join(sorted(given - set(ORDERS[nearest].names)))) or "none at all"
    return (
        f"keypoints: the names belong to no one order of {', '.join(ORDERS)}; not in {nearest}: {unknown}. Its names: "
        f"{', '.join(ORDERS[nearest].names)}"
    )


def _person(entries: Sequence[Any], order: Any, form: str) -> Person:
    try:
        table = np.array([_entry(entry) for entry in entries], np.float64).reshape(-1, 4)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{_ENTRY} ({reason(error)})") from error
    orders = orders_of(len(table)) if order is None else (order,)
    if not orders or len(table) != len(ORDERS[orders[0]].names):
        foreign = f" ({_FOREIGN[len(table)]}?)" if len(table) in _FOREIGN else ""
        expected = ", ".join(f"{len(each.names)} ({name})" for name, each in ORDERS.items())
        raise ValueError(
            f"keypoints: expected {expected} of them, got {len(table)}{foreign}"
            + (f" with the order {order}" if order else "")
            + "; give those that are missing as null, or all by the names of one of these orders"
        )
    return Person(_without_z(table, orders, entries), orders, form)


def _without_z(table: np.ndarray, orders: tuple[str, ...], entries: Sequence[Any]) -> np.ndarray:
    """`(K, 3)` of `(K, 4)`: where four numbers came, the third is z."""
    has_four = np.isfinite(table[:, 3])
    third = np.where(has_four, table[:, 3], table[:, 2])
    if orders == ("mediapipe33",):
        if not has_four.any() and (np.nan_to_num(third) < 0).any():
            third[:] = np.nan  # x, y, z alone
    elif any(_is_list(entry) and len(entry) == 4 for entry in entries):
        raise ValueError(f"{_ENTRY} (got 4 numbers: {shown(table[0].tolist())})")
    return np.concatenate([table[:, :2], third[:, None]], 1)


def _check_order(order: Any) -> None:
    if not (isinstance(order, str) and order in ORDERS):
        raise ValueError(
            f"keypoints: expected an order of {KNOWN_ORDERS}, got {shown(order)}; give one of these names, or leave "
            "the order out"
        )


def _entry(entry: Any) -> list[float]:
    """`[u, v, third, fourth]` of one keypoint; NaN where there is none, and a third of 0 where all is missing."""
    if entry is None:
        return [np.nan, np.nan, 0, np.nan]
    if isinstance(entry, str):
        raise TypeError(f"got the text {shown(entry)}")
    if isinstance(entry, Mapping):
        for pair in (("x", "y"), ("u", "v")):
            if all(key in entry for key in pair):
                keys = ("visibility", "confidence", "score", "presence")
                third = next((entry[key] for key in keys if entry.get(key) is not None), np.nan)
                return [_number(entry[pair[0]]), _number(entry[pair[1]]), _number(third), np.nan]
        raise TypeError(f"got names of no place: {shown(sorted(map(str, entry)))}")
    values = [_number(value) for value in entry]
    if len(values) not in (2, 3, 4):
        raise ValueError(f"got {len(values)} numbers: {shown(values)}")
    if len(values) > 2 and entry[-1] is not None and np.isnan(values[-1]):
        values[-1] = 0  # a confidence of NaN
    return [*values, *[np.nan] * (4 - len(values))]


def _number(value: Any) -> float:
    if isinstance(value, str):
        raise TypeError(f"got the text {shown(value)}")
    return np.nan if value is None else float(value)


def _numbers(rows: Sequence[Any], width: int) -> list[list[float]]:
    try:
        return [[_number(value) for value in row] for row in rows]
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"keypoints: expected {width} numbers ({reason(error)})") from error


def _unflattened(values: Sequence[Any], order: Any) -> list[Any]:
    """The entries of u, v (and confidence) one after another: of the width that makes a known number of them."""
    for width in (3, 2, 4):
        count, rest = divmod(len(values), width)
        known = orders_of(count) if order is None else (order,)
        if not rest and known and count == len(ORDERS[known[0]].names):
            return [list(values[start : start + width]) for start in range(0, len(values), width)]
    raise ValueError(
        f"keypoints: got a flat list of {shown(len(values))}, expected u, v and confidence of each keypoint one after "
        f"another, of one of the orders {KNOWN_ORDERS}"
    )


def _listed(value: Any) -> Any:
    """A value, arrays and tensors as lists."""
    if hasattr(value, "tolist") and not isinstance(value, Mapping):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _is_person(entry: Any) -> bool:
    """Whether an entry of a list is a person, not a keypoint."""
    if isinstance(entry, Mapping):
        return bool(_PERSON_KEYS & entry.keys()) or order_of_names(entry) is not None
    if not _is_list(entry):
        return False
    is_nested = any(_is_list(_listed(value)) or isinstance(value, Mapping) for value in entry)
    return is_nested or len(entry) > 4
