"""The tables and rows of the benchmark on rendered samples."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ljn.benchmark.conditions import Axis, Step
from ljn.benchmark.frames import BenchSamples
from ljn.benchmark.measures import COLUMNS, Errors, chosen, summary
from ljn.benchmark.outcome import Section, entry
from ljn.benchmark.predictors import Entrant
from ljn.report.charts import Series, line_chart
from ljn.report.writers import Entry, Sheet

BASES = {True: "10 px keypoints", False: "no keypoints"}
"""What the base condition is called, with keypoints and without."""
FAILED = "FAILED"


class Measured(NamedTuple):
    """What became of a predictor under a condition: errors, or why there are none."""

    entrant: Entrant
    step: Step
    errors: Errors | None
    status: str  # "" with errors


BASE_AXIS = Axis("base", "base", ("",), lambda condition, _: condition)


def describe(step: Step) -> str:
    """A step in a few words."""
    words = BASES[step.with_keypoints] if step.axis is BASE_AXIS else f"{step.axis.label} {step.value}"
    return words if step.with_keypoints or step.axis is BASE_AXIS else f"{words}, no keypoints"


def result_row(
    each: Measured,
    axis: str | None = None,
    value: Any = None,
    num: int | None = None,
    errors: Errors | None = None,
) -> dict[str, Any]:
    """A row of `results.csv`: of a condition, or of a group of the base condition's samples."""
    if axis is None:
        axis, value, errors = each.step.axis.name, each.step.value, each.errors
        num = None if errors is None else len(errors["mpjpe"])
    row = {
        "predictor": each.entrant.name,
        "axis": axis,
        "value": value,
        "keypoints": "given" if each.step.with_keypoints else "none",
        "samples": num,
        "status": each.status,
    }
    return (
        row
        | dict.fromkeys((column.key for column in COLUMNS), "")
        | summary(errors or {"mpjpe": np.empty(0)})
    )


def sample_rows(measured: Sequence[Measured]) -> Iterator[dict[str, Any]]:
    """The rows of `samples.csv`."""
    for each in measured:
        if each.errors is None:
            continue
        names = [name for name in each.errors if name != "joints_mm"]
        for number in range(len(each.errors["mpjpe"])):
            yield {
                "predictor": each.entrant.name,
                "axis": each.step.axis.name,
                "value": each.step.value,
                "keypoints": "given" if each.step.with_keypoints else "none",
                "sample": number,
                **{name: f"{each.errors[name][number]:.3f}" for name in names},
            }


def _leading_number(group: str) -> tuple[float, str]:
    """Sorts ranges by their lower end, and other names by themselves."""
    head = group.partition("-")[0]
    return (float(head), group) if head.isdigit() else (0.0, group)


def _cell(row: Mapping[str, Any], key: str) -> Entry:
    value = row.get(key)
    if isinstance(value, float):
        return entry(value)
    status = row.get("status") or None
    return Entry(FAILED, "word") if status == FAILED else entry(status)


_BASE_COLUMNS = (
    "mpjpe_mean", "mpjpe_median", "mpjpe_p90", "root_aligned_mean", "procrustes_mean", "under_10cm", "exchanged",
    "pve_mean", "pve_median", "pve_root_aligned_mean",
)  # fmt: skip


def base_section(bases: Sequence[Measured], num: int) -> Section:
    """All predictors under the base condition, a row each."""
    sheet = _sheet_of_columns(bases, _BASE_COLUMNS)
    notes = [
        f"{num} samples; keypoints with 10 px of noise, or none; depth with 1 mm of noise. Errors in mm, in the camera "
        "frame where no alignment is named; PVE: of the mesh's vertices."
    ]
    return Section("base", "Base condition", sheet, (), notes)


def details_section(bases: Sequence[Measured]) -> Section:
    """Every number of the base condition."""
    rest = [column.key for column in COLUMNS if column.key not in _BASE_COLUMNS]
    return Section("details", "Base condition, all other numbers", _sheet_of_columns(bases, rest))


def _sheet_of_columns(bases: Sequence[Measured], keys: Sequence[str]) -> Sheet:
    labels = {column.key: column.label for column in COLUMNS}
    rows = []
    for each in bases:
        if each.errors is None and each.status != FAILED:
            continue  # what it cannot do, or does not read
        row = result_row(each)
        label = f"{each.entrant.name}, {BASES[each.step.with_keypoints]}"
        rows.append([Entry(label), *(_cell(row, key) for key in keys)])
    return Sheet([("", 1 + len(keys))], ["", *(labels[key] for key in keys)], rows)


class _Line(NamedTuple):
    """A predictor's column of an axis or of groups: its numbers by value."""

    predictor: str
    colour: int
    with_keypoints: bool
    key: str
    rows: Mapping[Any, Mapping[str, Any]]

    @property
    def heading(self) -> str:
        """Below the predictor's name."""
        label = "PVE" if self.key == "pve_mean" else "MPJPE"
        return label if self.with_keypoints else f"{label}, no keypoints"


def _lines(rows: Sequence[Mapping[str, Any]]) -> list[_Line]:
    """The columns of rows: for each predictor, with keypoints and without, joints and, where it has them, meshes."""
    by_line: dict[tuple[str, bool], dict[Any, Mapping[str, Any]]] = {}
    for row in rows:
        by_line.setdefault((row["predictor"], row["keypoints"] == "given"), {})[row["value"]] = row
    predictors = list(dict.fromkeys(predictor for predictor, _ in by_line))
    lines = []
    for predictor in predictors:
        of_predictor = {key[1]: values for key, values in by_line.items() if key[0] == predictor}
        # A way of prediction that it has not is not worth a column, unless it has none at all.
        shown = {key: values for key, values in of_predictor.items() if _has(values, "mpjpe_mean")}
        for with_keypoints, values in (shown or dict([next(iter(of_predictor.items()))])).items():
            for key in ("mpjpe_mean", "pve_mean"):
                if key == "mpjpe_mean" or _has(values, key):
                    lines.append(_Line(predictor, predictors.index(predictor), with_keypoints, key, values))
    return lines


def _has(values: Mapping[Any, Mapping[str, Any]], key: str) -> bool:
    return any(isinstance(row.get(key), float) for row in values.values())


def _sheet_of_lines(
    lines: Sequence[_Line], values: Sequence[Any], counts: Sequence[int] | None = None
) -> Sheet:
    """Values down, predictors across; with the numbers of samples where they differ."""
    groups: list[tuple[str, int]] = []
    for line in lines:
        if groups and groups[-1][0] == line.predictor:
            groups[-1] = (line.predictor, groups[-1][1] + 1)
        else:
            groups.append((line.predictor, 1))
    rows = []
    for number, value in enumerate(values):
        cells = [_cell(line.rows[value], line.key) if value in line.rows else entry(None) for line in lines]
        count = [] if counts is None else [Entry(str(counts[number]))]
        rows.append([Entry(str(value)), *count, *cells])
    extra = 0 if counts is None else 1
    return Sheet(
        [("", 1 + extra), *groups], ["", *["number"] * extra, *(line.heading for line in lines)], rows
    )


def _charts(lines: Sequence[_Line], values: Sequence[Any], label: str) -> list[str]:
    """Means over an axis of numbers: a chart of the joints' errors, and one of the meshes'."""
    if not all(isinstance(value, int | float) for value in values):
        return []
    charts = []
    for key, title in (("mpjpe_mean", "MPJPE"), ("pve_mean", "PVE")):
        series = []
        for line in lines:
            points = [(float(value), row.get(key)) for value, row in line.rows.items()]
            numbers = tuple((x, y, None) for x, y in points if isinstance(y, float))
            if line.key == key and numbers:
                words = line.predictor if line.with_keypoints else f"{line.predictor}, no keypoints"
                series.append(Series(words, numbers, line.colour, is_dashed=not line.with_keypoints))
        charts.append(line_chart(series, f"{title} by {label}", label, f"{title}, mm"))
    return charts


def axis_section(axis: Axis, measured: Sequence[Measured], num: int) -> Section:
    """An axis's means over its `num` samples, predictors side by side, and their curves."""
    lines = _lines([result_row(each) for each in measured])
    if axis.is_of_mesh and any(line.key == "pve_mean" for line in lines):
        lines = [line for line in lines if line.key == "pve_mean" or not _has(line.rows, "pve_mean")]
    name = f"{axis.label[0].upper()}{axis.label[1:]}"
    notes = [f"Means in mm over the first {num} samples."]
    return Section(
        axis.name, name, _sheet_of_lines(lines, axis.values), _charts(lines, axis.values, axis.label), notes
    )


def group_section(name: str, label: str, rows: Sequence[Mapping[str, Any]]) -> Section:
    """One way to divide the base condition's samples (see `group_rows`), predictors side by side."""
    lines = _lines(rows)
    values = list(dict.fromkeys(row["value"] for row in rows))
    counts = [next(row["samples"] for row in rows if row["value"] == value) for value in values]
    title = f"By {label}" if label != "joints" else "Visible and occluded joints"
    what = "joints" if label == "joints" else "samples"
    notes = [f"The base condition's {what}, means in mm; number: of {what} in the group."]
    if label == "joints":
        notes.append(
            "A joint is visible where the depth at its pixel is the body's and at most 0.15 m before the joint."
        )
    return Section(name, title, _sheet_of_lines(lines, values, counts), (), notes)


def group_rows(
    samples: BenchSamples, bases: Sequence[Measured]
) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """Of each way to divide the samples its name, its label and rows of results, group by group."""
    divided = []
    for label, names in samples.groups().items():
        rows = []
        for group in sorted(set(names.tolist()), key=_leading_number):
            for each in bases:
                of_group = None if each.errors is None else chosen(each.errors, names == group)
                rows.append(result_row(each, label, group, int((names == group).sum()), of_group))
        divided.append((label.split(",")[0].replace(" ", "_"), label, rows))
    visible, rows = samples.visible(), []
    for group, mask in (("visible", visible), ("occluded", ~visible)):
        for each in bases:
            row = result_row(each, "joints", group, int(mask.sum()), None)
            if each.errors is not None and mask.any():
                errors = each.errors["joints_mm"][mask].astype(np.float64)
                row |= {
                    "status": "",
                    "mpjpe_mean": float(errors.mean()),
                    "mpjpe_median": float(np.median(errors)),
                    "under_5cm": float(100 * (errors < 50).mean()),
                    "under_10cm": float(100 * (errors < 100).mean()),
                }
            rows.append(row)
    divided.append(("visibility", "joints", rows))
    return divided
