"""The benchmark on real frames: predictors, other methods and lifted pixels against labels, joint by joint."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ljn.benchmark.frames import BenchFrame, BenchSamples
from ljn.benchmark.labels import JointMap, LabelledFrames, joint_map, read_labelled_frames
from ljn.benchmark.offsets import Offsets, fit_offsets
from ljn.benchmark.outcome import Outcome, Section, entry
from ljn.benchmark.predictors import Entrant
from ljn.benchmark.store import Store
from ljn.cloud.lifting import lift_keypoints
from ljn.report.charts import Series, line_chart
from ljn.report.writers import Entry, Sheet

BATCH = 40
_LABELS = {"all": "all labels", "on the person": "labels on the person"}
_OFFSETS = {
    "none": "as it is",
    "fixed": "fixed offset off",
    "fitted": "each joint's mean offset off",
}
_STATISTICS = {"mean": "mean", "median": "median", "under_10cm": "< 10 cm, %"}
_THRESHOLDS_MM = range(10, 210, 10)


class Method(NamedTuple):
    """What one method says of the frames.

    Attributes:
        name: Its name, with what it was given.
        joints: `(N, J, 3)` float64, metres, camera frame; None where it failed or was not measured.
        status: Why there are none.
        is_of_body: Whether its joints are SMPL's, which the fixed offset is between.
    """

    name: str
    joints: np.ndarray | None
    status: str = ""
    is_of_body: bool = False


class RealBenchmark:
    """Predictors on a file of real frames with labels.

    Args:
        path: The file; see `ljn.benchmark.labels`.
        samples: The benchmark's bodies, which the fixed offset is fitted on.
        joints: Which SMPL joint, or mean of several, a label's name stands for; see `joint_map`.
        surface_depth_m: How far behind the surface each name's labels lie, metres; empty: there is no fixed offset.
        person_m: A label lies on the person where a point of the cloud is within this distance, metres.
        num_samples: The first so many of the bodies; None: all.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file, or a name, is wrong.
    """

    def __init__(
        self,
        path: str | Path | None,
        samples: BenchSamples,
        joints: Mapping[str, Any] | None = None,
        surface_depth_m: Mapping[str, float] | None = None,
        person_m: float = 0.1,
        num_samples: int | None = None,
    ) -> None:
        self.frames: LabelledFrames = read_labelled_frames(path)
        self.mapped: JointMap = joint_map(self.frames.names, joints or {})
        self.surface_depth_m = dict(surface_depth_m or {})
        self.person_m = person_m
        self.samples = samples if num_samples is None else samples.first(num_samples)

    def run(self, entrants: Sequence[Entrant], store: Store, tick: Callable[[str], None]) -> Outcome:
        """Measure all, without keypoints and with the labels' own, each written into `store` as it comes.

        Args:
            entrants: What is measured. One that fails costs the others nothing.
            store: Where predictions are kept.
            tick: Called with a few words before each.
        """
        failures: list[str] = []
        methods = []
        for each in entrants:
            for has_keypoints in (False, True):
                name = f"{each.name}, {'keypoints of the labels' if has_keypoints else 'no keypoints'}"
                if status := each.skips("", has_keypoints):
                    methods.append(Method(name, None, status))
                    continue
                tick(name)
                try:
                    joints = self.mapped(self._joints(each, has_keypoints, store).astype(np.float64))
                    methods.append(Method(name, joints, is_of_body=not each.is_on_surface))
                except ValueError as error:
                    failures.append(f"{name}: {error}")
                    methods.append(Method(name, None, "FAILED"))
        pixels = self.frames.pixels()
        lifted = [
            lift_keypoints(each, depth, self.frames.camera) for each, depth in zip(pixels, self.frames.depth)
        ]
        methods.append(Method("lifted: the labels' pixels, the depth there", np.array(lifted, np.float64)))
        methods += [Method(name, joints) for name, joints in self.frames.others.items()]
        offsets = None
        if self.surface_depth_m:
            tick("the fixed offset")
            offsets = fit_offsets(self.samples, self.mapped, self.surface_depth_m)
        return self._outcome(methods, offsets, failures)

    def _joints(self, each: Entrant, has_keypoints: bool, store: Store) -> np.ndarray:
        """A predictor's joints `(N, 24, 3)`, from `store` where they are there."""
        frames = self.frames
        identity: dict[str, Any] = {"frames": frames.hash, "predictor": each.fingerprint}
        keypoints = None
        if has_keypoints:
            keypoints = self.mapped.keypoints(frames.pixels())
            identity["keypoints"] = self.mapped.joints
        if (kept := store.get(identity, len(frames.depth))) is not None:
            return kept["joints"]
        found = []
        for start in range(0, len(frames.depth), BATCH):
            numbers = range(start, min(start + BATCH, len(frames.depth)))
            batch = [
                BenchFrame(frames.depth[n], frames.camera, None if keypoints is None else keypoints[n])
                for n in numbers
            ]
            found.append(each(batch, numbers).joints)
        joints = np.concatenate(found)
        store.put(identity, {"joints": joints})
        return joints

    def _outcome(self, methods: Sequence[Method], offsets: Offsets | None, failures: list[str]) -> Outcome:
        frames = self.frames
        is_on = frames.on_person(self.person_m)
        chosen = {"all": np.ones_like(is_on), "on the person": is_on}
        errors = {
            (method.name, labels, offset): self._errors(method, offset, mask, offsets)
            for method in methods
            for labels, mask in chosen.items()
            for offset in _OFFSETS
        }
        rows = [
            {
                "method": method.name,
                "labels": labels,
                "offset": offset,
                "joint": joint,
                "number": None if values is None else int(np.isfinite(values).sum()),
                "status": method.status,
                **_numbers(values),
            }
            for (name, labels, offset), of_all in errors.items()
            for method in methods
            if method.name == name
            for joint, values in self._by_joint(of_all)
        ]
        exchanged = {method.name: self._num_exchanged(method) for method in methods}
        percent = 100 * float(is_on.mean())
        sections = [_section(labels, methods, errors, exchanged, len(frames.depth)) for labels in chosen]
        sections[0].notes.extend(_notes(offsets is not None))
        sections[1].notes.append(
            f"{percent:.1f} % of the labels lie on the person: a point of the masked cloud is within "
            f"{100 * self.person_m:g} cm."
        )
        sections[0] = replace(sections[0], charts=[_curves(methods, errors)])
        sections += [self._joint_section(offset, methods, errors) for offset in _OFFSETS]
        if offsets is not None:
            sections.append(_offset_section(self.mapped.names, self.surface_depth_m, offsets))
        return Outcome(
            frames.name,
            {
                "frames": frames.hash,
                "joints": self.mapped.joints,
                "surface_depth_m": self.surface_depth_m,
                "person_m": self.person_m,
                "samples": len(self.samples) if self.surface_depth_m else None,
            },
            {
                "file": frames.name,
                "hash": frames.hash,
                "frames": len(frames.depth),
                "labels a frame": len(frames.names),
                "image": f"{frames.camera.width} x {frames.camera.height}",
                "labels on the person": f"{percent:.1f} %",
            },
            sections,
            rows,
            self._frame_rows(methods, errors),
            failures,
            {
                f"benchmark/{method.name}": float(np.nanmean(values))
                for method in methods
                if (values := errors[method.name, "all", "none"]) is not None
            },
        )

    def _errors(
        self, method: Method, offset: str, mask: np.ndarray, offsets: Offsets | None
    ) -> np.ndarray | None:
        """`(N, J)`, mm: distances to the labels, NaN where `mask` is false; None where there are none of the kind."""
        if method.joints is None:
            return None
        difference = method.joints - self.frames.joints
        if offset == "fixed":
            if offsets is None or not method.is_of_body:
                return None
            difference = difference + offsets.metres
        difference = np.where(mask[..., None], difference, np.nan)
        if offset == "fitted":
            counts = np.maximum(mask.sum(0), 1)[:, None]
            difference = difference - np.nansum(difference, 0) / counts
        return 1000 * np.linalg.norm(difference, axis=-1)

    def _by_joint(self, errors: np.ndarray | None) -> Iterator[tuple[str, np.ndarray | None]]:
        yield "all", errors
        for place, name in enumerate(self.mapped.names):
            yield name, None if errors is None else errors[:, place]

    def _num_exchanged(self, method: Method) -> int | None:
        """Frames that would fit the labels better with left and right exchanged."""
        if method.joints is None:
            return None
        as_is, other = (
            np.linalg.norm(joints - self.frames.joints, axis=-1).mean(-1)
            for joints in (method.joints, method.joints[:, self.mapped.mirror])
        )
        return int((other < as_is).sum())

    def _frame_rows(
        self, methods: Sequence[Method], errors: Mapping[tuple[str, str, str], np.ndarray | None]
    ) -> Iterator[dict[str, Any]]:
        """The rows of `samples.csv`: each frame's mean error over its labels, mm."""
        for method in methods:
            of_method = {offset: errors[method.name, "all", offset] for offset in _OFFSETS}
            for frame in range(len(self.frames.depth)):
                means = {
                    name: "" if values is None else f"{values[frame].mean():.3f}"
                    for name, values in of_method.items()
                }
                if any(means.values()):
                    yield {"method": method.name, "frame": frame, **means}

    def _joint_section(
        self,
        offset: str,
        methods: Sequence[Method],
        errors: Mapping[tuple[str, str, str], np.ndarray | None],
    ) -> Section:
        shown = [method for method in methods if errors[method.name, "all", offset] is not None]
        rows = []
        for place, name in enumerate(self.mapped.names):
            cells = []
            for method in shown:
                values = errors[method.name, "all", offset]
                cells.append(entry(None if values is None else float(values[:, place].mean())))
            rows.append([Entry(name), *cells])
        sheet = Sheet([("", 1 + len(shown))], ["", *(method.name for method in shown)], rows)
        return Section(f"joints-{offset}", f"Each joint, {_OFFSETS[offset]}: mean, mm", sheet)


def _numbers(errors: np.ndarray | None) -> dict[str, Any]:
    """Mean and median, mm, and the share under 10 cm, %; empty text without errors."""
    values = np.empty(0) if errors is None else errors[np.isfinite(errors)]
    if not len(values):
        return dict.fromkeys(_STATISTICS, "")
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "under_10cm": float(100 * (values < 100).mean()),
    }


def _section(
    labels: str,
    methods: Sequence[Method],
    errors: Mapping[tuple[str, str, str], np.ndarray | None],
    exchanged: Mapping[str, int | None],
    num: int,
) -> Section:
    """All methods on all labels, or on some, a row each."""
    groups = [("", 1), *((words, len(_STATISTICS)) for words in _OFFSETS.values()), ("", 1)]
    columns = ["", *(words for _ in _OFFSETS for words in _STATISTICS.values()), f"sides exchanged, of {num}"]
    rows = []
    for method in methods:
        if method.joints is None and method.status != "FAILED":
            continue  # nothing that it could do
        cells = []
        for offset in _OFFSETS:
            numbers = _numbers(errors[method.name, labels, offset])
            failed = Entry("FAILED", "word") if method.status == "FAILED" else entry(method.status or None)
            cells += [failed if value == "" else entry(value) for value in numbers.values()]
        rows.append([Entry(method.name), *cells, entry(exchanged[method.name])])
    title = f"Joints, {_LABELS[labels]}: mm"
    return Section(f"labels-{labels.split()[0]}", title, Sheet(groups, columns, rows))


def _notes(has_fixed: bool) -> list[str]:
    fixed = (
        "Fixed offset off: between SMPL's joints and points at a declared depth behind the surface, fitted on the "
        "synthetic body alone."
    )
    fitted = (
        "Each joint's mean offset off: the mean difference over these very frames, fitted on the labels; what is left "
        "is the spread."
    )
    return [fixed, fitted] if has_fixed else [fitted]


def _curves(methods: Sequence[Method], errors: Mapping[tuple[str, str, str], np.ndarray | None]) -> str:
    """The share of joints under a distance, by the distance: as they are, and dashed with the fixed offset off."""
    series = []
    for colour, method in enumerate(methods):
        for offset in ("none", "fixed"):
            values = errors[method.name, "all", offset]
            if values is None:
                continue
            points = tuple(
                (float(limit), float(100 * (values < limit).mean()), None) for limit in _THRESHOLDS_MM
            )
            words = method.name if offset == "none" else f"{method.name}, {_OFFSETS[offset]}"
            series.append(Series(words, points, colour, is_dashed=offset == "fixed", has_markers=False))
    return line_chart(series, "Joints within a distance of their labels", "distance, mm", "joints, %")


def _offset_section(names: Sequence[str], declared: Mapping[str, float], offsets: Offsets) -> Section:
    rows = [
        [
            Entry(name),
            *(entry(1000.0 * value) for value in (float(declared[name]), *offset.tolist())),
            Entry(str(number)),
        ]
        for name, offset, number in zip(names, offsets.metres, offsets.numbers.tolist())
    ]
    columns = ["", "behind the surface", "x (right)", "y (down)", "z (forward)", "bodies"]
    return Section(
        "offsets",
        "The fixed offset from SMPL's joints to the labels, mm",
        Sheet([("", 6)], columns, rows),
        (),
        [
            "Fitted on the synthetic bodies that face the camera within 45 degrees; hidden joints are left out."
        ],
    )
