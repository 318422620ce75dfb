"""A sweep's runs as the rows of its tables: means and standard deviations over seeds beside the thesis's numbers."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ljn.report.ordering import Cell, Comparison, compare, count_claims
from ljn.report.tables import ROOT_ALIGNED, ROOT_ALIGNED_NOTE, TABLES, Axis, Column, Row, Table
from ljn.runs.sweep import Run, Sweep, number_of, read_sweep, varying


@dataclass(frozen=True)
class RowResult:
    """A row of a table."""

    row: Row
    label: str  # what it is called, with what tells it from other runs of its experiment
    runs: tuple[Run, ...]  # one for each seed
    cells: tuple[Cell, ...]  # one for each column
    x: float | None  # its place on the table's axis: the value that its runs were configured with

    @property
    def is_shared(self) -> bool:
        """Whether it shows a value that all runs share, from any of them."""
        return self.row.experiment is None and self.row.overrides is None

    @property
    def is_failed(self) -> bool:
        """Whether any of its runs failed."""
        return any(run.status == "failed" for run in self.runs)

    @property
    def status(self) -> str:
        """`complete`, or how many runs failed or are missing."""
        if not self.runs:
            return "missing"
        parts = []
        for kind in ("failed", "missing"):
            number = sum(run.status == kind for run in self.runs)
            if number:
                parts.append(kind if number == len(self.runs) else f"{kind} {number} of {len(self.runs)}")
        return ", ".join(parts) or "complete"


@dataclass(frozen=True)
class TableResult:
    """A table with results."""

    table: Table
    rows: tuple[RowResult, ...]
    # between its rows: those that the thesis's numbers claim, or else the best row and the others
    comparisons: tuple[Comparison, ...]
    # of each column, how many pairs of rows the thesis puts in an order, with results or without
    num_claims: tuple[int, ...]

    @property
    def has_thesis(self) -> tuple[bool, ...]:
        """Of each column, whether any row has a number of the thesis."""
        columns = range(len(self.table.columns))
        return tuple(any(row.cells[number].thesis is not None for row in self.rows) for number in columns)


@dataclass(frozen=True)
class Results:
    """A sweep's tables."""

    sweep: Sweep
    tables: tuple[TableResult, ...]  # runs that belong to none of those asked for have a table for themselves

    @property
    def lost(self) -> tuple[Run, ...]:
        """The runs that failed, then those that left no result although nothing says that they failed."""
        return tuple(run for kind in ("failed", "missing") for run in self.sweep.runs if run.status == kind)


def read_results(directory: Path) -> Results:
    """The tables of a sweep, from the directory that holds its `sweep.json`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or names a table that there is not.
    """
    sweep = read_sweep(directory)
    unknown = [name for name in sweep.tables if name not in TABLES]
    if unknown:
        raise ValueError(f"tables: expected some of {', '.join(TABLES)}, got {', '.join(unknown):.200}")
    tables = [TABLES[name] for name in sweep.tables]
    wanted = {row.experiment for table in tables for row in table.rows}
    others = [run for run in sweep.runs if run.experiment not in wanted or run.experiment is None]
    if others or not tables:
        title = f"Other runs of {sweep.name}" if tables else sweep.name
        tables += grids(sweep.name if not tables else "other_runs", title, others)
    return Results(sweep, tuple(_fill(table, sweep.runs) for table in tables))


def grids(name: str, title: str, runs: Sequence[Run]) -> list[Table]:
    """Tables of any runs: a row for each setting, a table for each stage, whose metrics are its own."""
    settings: dict[Any, list[Run]] = {}
    for run in runs:
        settings.setdefault((run.experiment, run.overrides), []).append(run)
    stages: dict[str, list[Run]] = {}
    unknown: list[Run] = []
    for group in settings.values():
        stage = next((run.stage for run in group if run.stage), None)
        (unknown if stage is None else stages.setdefault(stage, [])).extend(group)
    if len(stages) < 2:
        return [_grid(name, title, runs)]
    first = min(stages)
    stages[first] += unknown  # which left nothing to tell its stage by
    return [_grid(f"{name}_{stage}", f"{title}: {stage}", stages[stage]) for stage in sorted(stages)]


def _grid(name: str, title: str, runs: Sequence[Run]) -> Table:
    """The table of one stage's runs."""
    changing = varying(run.overrides for run in runs)
    has_experiments = len({run.experiment for run in runs}) > 1
    settings = list(dict.fromkeys((run.experiment, run.overrides) for run in runs))
    root_relative = {(run.experiment, run.overrides) for run in runs if run.is_root_relative}
    keys = {override.partition("=")[0] for override in changing}
    axis = None
    if len(keys) == 1 and not has_experiments and all(_value(override) is not None for override in changing):
        axis = Axis(min(keys), min(keys))
    rows = []
    for experiment, overrides in settings:
        shown = [override for override in overrides if override in changing]
        parts = ([experiment] if experiment and (has_experiments or not shown) else []) + shown
        x = _value(shown[0]) if axis and shown else None
        metrics = ROOT_ALIGNED if (experiment, overrides) in root_relative else {}
        rows.append(Row(", ".join(parts) or name, experiment, x=x, metrics=metrics, overrides=overrides))
    notes = (ROOT_ALIGNED_NOTE,) if root_relative else ()
    return Table(name, title, _columns(runs), tuple(rows), axis=axis, notes=notes)


def _columns(runs: Sequence[Run]) -> tuple[Column, ...]:
    """The headline metrics, as the runs' records say; where none does, every metric that there is."""
    known = dict.fromkeys(metric for run in runs for metric in run.metrics)
    headline = next((run.headline for run in runs if run.headline), {})
    columns = [
        Column(key, key, str(facts.get("unit", "")), _GOALS.get(str(facts.get("goal"))))
        for key, facts in headline.items()
    ]
    present = [column for column in columns if column.metric in known] or columns[:1]
    return tuple(present or [Column(key, key, "") for key in known] or [Column("result", "result", "")])


_GOALS: dict[str, Literal["min", "max"]] = {"min": "min", "max": "max"}


def _value(override: str) -> float | None:
    return number_of(override.partition("=")[2])


def _fill(table: Table, runs: Sequence[Run]) -> TableResult:
    rows = tuple(result for row in table.rows for result in _fill_row(row, table, runs))
    columns = [[row.cells[number] for row in rows] for number in range(len(table.columns))]
    return TableResult(table, rows, compare(columns), tuple(map(count_claims, columns)))


def _fill_row(row: Row, table: Table, runs: Sequence[Run]) -> list[RowResult]:
    """A row's results: several where its experiment ran with several settings."""
    if row.overrides is not None:
        same = [run for run in runs if (run.experiment, run.overrides) == (row.experiment, row.overrides)]
        return [_result(row, row.label, same, table)]
    if row.experiment is None:
        return [_result(row, row.label, [run for run in runs if run.status == "complete"][:1], table)]
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        if run.experiment == row.experiment:
            groups.setdefault(run.overrides, []).append(run)
    changing = varying(groups)
    results = []
    for overrides, group in (groups or {(): []}).items():
        shown = [override for override in overrides if override in changing]
        label = f"{row.label} ({', '.join(shown)})" if shown else row.label
        results.append(_result(row, label, group, table))
    return results


def _result(row: Row, label: str, runs: Sequence[Run], table: Table) -> RowResult:
    cells = []
    for column in table.columns:
        metric = row.metrics.get(column.metric, column.metric)
        values = [run.metrics[metric] for run in runs if metric is not None and metric in run.metrics]
        mean = math.fsum(values) / len(values) if values else None
        sd = statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else None
        thesis = row.thesis.get(column.metric)
        cells.append(Cell(column, label, tuple(runs), metric, mean, sd, len(values), thesis))
    x = row.x
    if table.axis is not None and row.x is not None:
        configured = (run.setting(table.axis.key) for run in runs)
        x = next((value for value in configured if value is not None), row.x)
    return RowResult(row, label, tuple(runs), tuple(cells), x)
