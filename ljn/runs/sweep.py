"""What a sweep's runs left on disk, read without trusting that any of it is there."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ljn.reading import READ_ERRORS, read_arrays, read_yaml
from ljn.runs import layout
from ljn.runs.files import read_json, read_metrics
from ljn.runs.keys import key_of, kind_of

Status = Literal["complete", "failed", "missing"]


def settings(overrides: Iterable[str], preset: str) -> tuple[str, ...]:
    """Those of a job's typed overrides that say what its run is, sorted; all jobs share the preset."""
    is_preset = {line for line in overrides if (key_of(line), line.partition("=")[2]) == ("preset", preset)}
    return tuple(
        sorted(line for line in overrides if kind_of(key_of(line)).is_setting and line not in is_preset)
    )


@dataclass(frozen=True)
class Run:
    """A job of a sweep and what its run left."""

    experiment: str | None  # such as `detector/basic`; None in a free grid
    overrides: tuple[str, ...]  # of its task overrides, `settings`
    seed: int | None
    directory: Path | None  # the run's directory; None for a job that never had one
    status: Status  # `missing`: nothing says that it failed, but it has no result
    error: str | None = None  # of a failed job
    # test metrics without `test/`: millimetres, pixels and percent; NaN where a number was not finite
    metrics: Mapping[str, float] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)  # `record.json`, or nothing

    @property
    def name(self) -> str:
        """The directory's name, or what tells the job from others."""
        if self.directory is not None:
            return self.directory.name
        parts = [self.experiment, *self.overrides, None if self.seed is None else f"seed={self.seed}"]
        return " ".join(part for part in parts if part) or "job without overrides"

    @property
    def data(self) -> Mapping[str, Any]:
        """What the record says of the data."""
        return mapping(self.record.get("data"))

    @property
    def stage(self) -> str | None:
        """What its stage is called; None where the record does not say."""
        stage = self.record.get("stage")
        return stage if isinstance(stage, str) else None

    @property
    def headline(self) -> dict[str, Mapping[str, Any]]:
        """`unit` and `goal` of the metrics that a table of results shows; nothing where the record does not say."""
        metrics = mapping(self.record.get("metrics"))
        keys = (str(key) for key in _list(self.record.get("headline")))
        return {key: mapping(metrics.get(key)) for key in keys}

    @property
    def is_root_relative(self) -> bool:
        """Whether its joints are only defined relative to the root, as the record says."""
        return self.record.get("is_root_relative") is True

    @property
    def picture(self) -> Path | None:
        """The page of its best, median and worst test samples."""
        path = self.directory and self.directory / layout.PICTURES / layout.EXTREMES
        return path if path and path.is_file() else None

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """Its resolved configuration, or nothing."""
        if self.directory is None:
            return {}
        try:
            return mapping(read_yaml(self.directory / layout.CONFIG))
        except READ_ERRORS:
            return {}

    def setting(self, key: str) -> float | None:
        """A number of its configuration, such as `data.observation.num_points`; None where there is none."""
        value: Any = self.config
        for part in key.split("."):
            value = mapping(value).get(part)
        return float(value) if isinstance(value, int | float) else None

    @cached_property
    def _csv_rows(self) -> list[dict[str, str]]:
        rows: list[dict[str, str]] = []
        for path in sorted(self.directory.glob(layout.CURVES), key=_version) if self.directory else ():
            try:
                with path.open(newline="") as file:
                    rows += list(csv.DictReader(file))
            except (OSError, ValueError, csv.Error):
                continue
        return rows

    def curve(self, metric: str) -> dict[int, float]:
        """A validation metric (without `val/`) by epoch, counted from 1, over all attempts of the run."""
        trained: set[int] = set()
        values: dict[int, float] = {}
        for row in self._csv_rows:
            epoch, value = number_of(row.get("epoch")), number_of(row.get(f"val/{metric}"))
            if epoch is None:
                continue
            if number_of(row.get("train/loss")) is not None:
                trained.add(int(epoch))
            if value is not None:
                values[int(epoch)] = value
        # The best checkpoint's validation after the training is logged as one more epoch.
        return {epoch + 1: values[epoch] for epoch in sorted(values) if epoch in trained}

    def sample_values(self, metric: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Its test samples `(S, T)`, each by its number and its truth, and a metric's values of them `(S,)`.

        None where they are not known.
        """
        truth = _list(self.record.get("truth"))
        if self.directory is None or not truth:
            return None
        try:
            arrays = read_arrays(self.directory / layout.SAMPLES, ("sample_id", metric, *truth))
            ids, values = arrays["sample_id"], arrays[metric].astype(np.float64)
            parts = [arrays[name].reshape(len(ids), -1) for name in truth]
            samples = np.column_stack([ids, *parts]).astype(np.float64)
        except READ_ERRORS:
            return None
        return (samples, values) if values.shape == (len(samples),) else None


@dataclass(frozen=True)
class Sweep:
    """A sweep: `sweep.json` and its runs."""

    name: str  # such as `table_3_2`
    preset: str  # the sizes, such as `small`
    tables: tuple[str, ...]  # names of the tables that it fills
    command: str  # what started it
    runs: tuple[Run, ...]  # in the jobs' order; of those of equal experiment, settings and seed, the first


def read_sweep(directory: Path) -> Sweep:
    """A sweep and its runs, from the directory that holds its `sweep.json`.

    Raises:
        FileNotFoundError: It does not.
        ValueError: That file is damaged.
    """
    path = directory / layout.SWEEP
    if not path.is_file():
        raise FileNotFoundError(
            f"directory: expected a sweep's directory with a {layout.SWEEP}, got '{directory}'"
        )
    content = read_json(path)
    if content is None or not isinstance(content.get("jobs"), list):
        raise ValueError(
            f"'{path}': expected an object with a list of jobs, got a damaged file; run the sweep again"
        )
    preset = str(content.get("preset") or "missing")
    runs: dict[Any, Run] = {}
    for job in read_jobs(directory):
        run = _read_run(job, directory, preset)
        runs.setdefault((run.experiment, run.overrides, run.seed), run)
    name, command = content.get("name") or directory.name, content.get("command") or "missing"
    tables = tuple(map(str, _list(content.get("tables"))))
    return Sweep(str(name), preset, tables, str(command), tuple(runs.values()))


def read_jobs(directory: Path) -> list[dict[str, Any]]:
    """The jobs of a sweep's `sweep.json`; none where it is missing or damaged."""
    return [job_of(job) for job in _list((read_json(directory / layout.SWEEP) or {}).get("jobs"))]


def job_of(content: Any) -> dict[str, Any]:
    """A job as `sweep.json` has it, read: what is of another type than it should be is None, or no override."""
    job = mapping(content)
    types = {"experiment": str, "run_dir": str, "status": str, "error": str, "seed": int}
    typed = {key: job[key] if isinstance(job.get(key), kind) else None for key, kind in types.items()}
    return typed | {"overrides": [str(override) for override in _list(job.get("overrides"))]}


def _read_run(job: Mapping[str, Any], sweep: Path, preset: str) -> Run:
    directory = _locate(job["run_dir"], sweep)
    record = (read_json(directory / layout.RECORD) if directory else None) or {}
    everything = (read_metrics(directory) if directory else None) or {}
    metrics = {key[5:]: value for key, value in everything.items() if key.startswith("test/")}
    error = job["error"] or record.get("error")
    status: Status = "complete"
    if job["status"] == "failed" or (not metrics and record.get("status") == "failed"):
        status, metrics = "failed", {}
    elif not metrics:
        status = "missing"
    error = None if status == "complete" or error is None else str(error)
    overrides = settings(job["overrides"], preset)
    return Run(job["experiment"], overrides, job["seed"], directory, status, error, metrics, record)


def _locate(run_dir: str | None, sweep: Path) -> Path | None:
    """A run's directory. A relative one is below the sweep's, or below one of the folders that hold that."""
    if not run_dir:
        return None
    places = [base / run_dir for base in (sweep, *sweep.absolute().parents)]  # an absolute one stays as it is
    try:
        return next((place for place in places if place.is_dir()), places[0])
    except OSError:  # a name that the file system does not take
        return None


def _version(path: Path) -> int:
    digits = path.parent.name.rpartition("_")[2]
    return int(digits) if digits.isdigit() else -1


def number_of(text: str | None) -> float | None:
    """The finite number that a text is; None for any other text."""
    try:
        value = float(text or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def mapping(value: Any) -> Mapping[str, Any]:
    """A mapping as it is; nothing for anything else."""
    return value if isinstance(value, Mapping) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def varying(settings: Iterable[tuple[str, ...]]) -> frozenset[str]:
    """The overrides that some of these have and others have not."""
    sets = list(map(frozenset, settings)) or [frozenset()]
    return sets[0].union(*sets) - sets[0].intersection(*sets)
