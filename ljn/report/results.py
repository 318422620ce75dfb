"""A sweep's runs as the rows of its tables: means and standard deviations over seeds beside the thesis's numbers."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ljn.report.ordering import Comparison, Contender, compare, count_claims
from ljn.report.tables import (
    APVE,
    MPJPE,
    PCKH,
    ROOT_ALIGNED,
    ROOT_ALIGNED_NOTE,
    TABLES,
    Axis,
    Column,
    Row,
    Table,
)
from ljn.runs.sweep import Run, Sweep, read_sweep, varying

_STAGES = {"detector": ("joint detectors", (MPJPE, PCKH)), "mesh": ("mesh regressors", (APVE, MPJPE))}
"""What a stage's models are called, and its metrics, by the folder of its experiments."""
_ROOT_RELATIVE = {
    row.experiment for table in TABLES.values() for row in table.rows if row.metrics is ROOT_ALIGNED
}


@dataclass(frozen=True)
class Cell:
    """A number of a table; in its column's unit.

    Attributes:
        column: Its column.
        metric: The metric that is shown; None where the row has no such value.
        mean: Over seeds; None without a result.
        sd: Standard deviation over seeds (one degree of freedom less); None of fewer than two.
        num_seeds: How many there are.
        thesis: The thesis's value.
    """

    column: Column
    metric: str | None
    mean: float | None
    sd: float | None
    num_seeds: int
    thesis: float | None

    @property
    def is_substituted(self) -> bool:
        """Whether it is of joints whose roots were moved to the same place, unlike the column's metric."""
        return self.metric != self.column.metric and self.metric in ROOT_ALIGNED.values()

    @property
    def difference(self) -> float | None:
        """Ours less the thesis's."""
        return None if self.mean is None or self.thesis is None else self.mean - self.thesis


@dataclass(frozen=True)
class RowResult:
    """A row of a table.

    Attributes:
        row: What was asked for.
        label: What it is called, with what tells it from other runs of its experiment.
        runs: One for each seed.
        cells: One for each column.
        x: Its place on the table's axis: the value that its runs were configured with.
    """

    row: Row
    label: str
    runs: tuple[Run, ...]
    cells: tuple[Cell, ...]
    x: float | None

    @property
    def is_shared(self) -> bool:
        """Whether it shows what all runs share, from any of them."""
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
    """A table with results.

    Attributes:
        table: What was asked for.
        rows: Its rows.
        comparisons: Between its rows: those that the thesis's numbers claim, or else the best row and the others.
        num_claims: Of each column, how many pairs of rows the thesis puts in an order, with results or without.
    """

    table: Table
    rows: tuple[RowResult, ...]
    comparisons: tuple[Comparison, ...]
    num_claims: tuple[int, ...]

    @property
    def has_thesis(self) -> tuple[bool, ...]:
        """Of each column, whether any row has a number of the thesis."""
        return tuple(
            any(row.cells[number].thesis is not None for row in self.rows)
            for number in range(len(self.table.columns))
        )


@dataclass(frozen=True)
class Results:
    """A sweep's tables.

    Attributes:
        sweep: The sweep.
        tables: Its tables; runs that belong to none of those asked for have one of their own.
    """

    sweep: Sweep
    tables: tuple[TableResult, ...]

    @property
    def failed(self) -> tuple[Run, ...]:
        """The runs that failed."""
        return tuple(run for run in self.sweep.runs if run.status == "failed")

    @property
    def missing(self) -> tuple[Run, ...]:
        """The runs that left no result although nothing says that they failed."""
        return tuple(run for run in self.sweep.runs if run.status == "missing")


def read_results(directory: Path) -> Results:
    """The tables of a sweep.

    Args:
        directory: Holds `sweep.json`.

    Raises:
        FileNotFoundError: It does not.
        ValueError: That file is damaged, or names a table that there is not.
    """
    sweep = read_sweep(directory)
    unknown = [name for name in sweep.tables if name not in TABLES]
    if unknown:
        raise ValueError(f"tables: expected some of {', '.join(TABLES)}, got {', '.join(unknown)}")
    tables = [TABLES[name] for name in sweep.tables]
    wanted = {row.experiment for table in tables for row in table.rows}
    others = [run for run in sweep.runs if run.experiment not in wanted or run.experiment is None]
    if others or not tables:
        title = f"Other runs of {sweep.name}" if tables else sweep.name
        tables += grids(sweep.name if not tables else "other_runs", title, others)
    return Results(sweep, tuple(_fill(table, sweep.runs) for table in tables))


def grids(name: str, title: str, runs: Sequence[Run]) -> list[Table]:
    """Tables of any runs: a row for each setting, with the metrics that there are.

    Joint detectors and mesh regressors have a table each: their errors are in different frames.

    Args:
        name: The table's name.
        title: Its title.
        runs: What is shown.
    """
    settings: dict[Any, list[Run]] = {}
    for run in runs:
        settings.setdefault((run.experiment, run.overrides), []).append(run)
    stages = {setting: _stage(group) for setting, group in settings.items()}
    found = [stage for stage in _STAGES if stage in stages.values()] or ["detector"]
    tables = []
    for stage in found:
        # What left nothing to tell its stage by goes into the first table.
        own = [run for run in runs if (stages[run.experiment, run.overrides] or found[0]) == stage]
        kind, columns = _STAGES[stage]
        names = (name, title) if len(found) == 1 else (f"{name}_{stage}", f"{title}: {kind}")
        tables.append(_grid(*names, columns, own))
    return tables


def _stage(runs: Sequence[Run]) -> str | None:
    """The stage of a setting's runs: what their metrics say, or else their experiment's folder."""
    known = {metric for run in runs for metric in run.metrics}
    if known:
        return "mesh" if "apve" in known else "detector"
    folder = (runs[0].experiment or "").partition("/")[0]
    return folder if folder in _STAGES else None


def _is_root_relative(run: Run) -> bool:
    """Whether its detector's joints only mean something beside the root."""
    if not run.metrics.keys() & ROOT_ALIGNED.values():
        return False
    if run.experiment in _ROOT_RELATIVE:
        return True
    model = run.config.get("model")
    module, _, name = str(model.get("_target_") if isinstance(model, Mapping) else None).rpartition(".")
    if not module.startswith("ljn.nets."):
        return False
    try:
        return getattr(getattr(import_module(module), name, None), "is_root_relative", False) is True
    except ImportError:
        return False


def _grid(name: str, title: str, columns: tuple[Column, ...], runs: Sequence[Run]) -> Table:
    """The table of one stage's runs."""
    changing = varying(run.overrides for run in runs)
    has_experiments = len({run.experiment for run in runs}) > 1
    settings = list(dict.fromkeys((run.experiment, run.overrides) for run in runs))
    root_relative = {(run.experiment, run.overrides) for run in runs if _is_root_relative(run)}
    keys = {override.partition("=")[0] for override in changing}
    axis = None
    if len(keys) == 1 and not has_experiments and all(_number(override) is not None for override in changing):
        axis = Axis(min(keys), min(keys))
    rows = []
    for experiment, overrides in settings:
        shown = [override for override in overrides if override in changing]
        parts = ([experiment] if experiment and (has_experiments or not shown) else []) + shown
        x = _number(shown[0]) if axis and shown else None
        metrics = ROOT_ALIGNED if (experiment, overrides) in root_relative else {}
        rows.append(Row(", ".join(parts) or name, experiment, x=x, metrics=metrics, overrides=overrides))
    known = {metric for run in runs for metric in run.metrics}
    present = tuple(column for column in columns if column.metric in known) or columns[:1]
    notes = (ROOT_ALIGNED_NOTE,) if root_relative else ()
    return Table(name, title, present, tuple(rows), axis=axis, notes=notes)


def _number(override: str) -> float | None:
    try:
        return float(override.partition("=")[2])
    except ValueError:
        return None


def _fill(table: Table, runs: Sequence[Run]) -> TableResult:
    rows = tuple(result for row in table.rows for result in _fill_row(row, table, runs))
    contenders = [
        [
            Contender(row.label, cell.metric, cell.mean, cell.sd, cell.thesis, row.runs)
            for row, cell in zip(rows, (row.cells[number] for row in rows))
        ]
        for number in range(len(table.columns))
    ]
    num_claims = tuple(map(count_claims, table.columns, contenders))
    return TableResult(table, rows, compare(table.columns, contenders), num_claims)


def _fill_row(row: Row, table: Table, runs: Sequence[Run]) -> list[RowResult]:
    """A row's results: several where its experiment ran with several settings."""
    if row.overrides is not None:
        own = [run for run in runs if (run.experiment, run.overrides) == (row.experiment, row.overrides)]
        return [_result(row, row.label, own, table)]
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
        cells.append(
            Cell(
                column=column,
                metric=metric,
                mean=math.fsum(values) / len(values) if values else None,
                sd=statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else None,
                num_seeds=len(values),
                thesis=row.thesis.get(column.metric),
            )
        )
    x = row.x
    if table.axis is not None and row.x is not None:
        own = [setting for run in runs if (setting := run.setting(table.axis.key)) is not None]
        x = own[0] if own else row.x
    return RowResult(row, label, tuple(runs), tuple(cells), x)
