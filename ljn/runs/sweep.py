"""What a sweep's runs left on disk, read without trusting that any of it is there."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from ljn.reading import READ_ERRORS
from ljn.runs.files import read_json
from ljn.runs.keys import key_of, kind_of

Status = Literal["complete", "failed", "missing"]


def settings(overrides: Iterable[str], preset: str) -> tuple[str, ...]:
    """Those of a job's typed overrides that say what its run is, sorted.

    Args:
        overrides: As they were typed.
        preset: The sweep's preset, which says nothing new.
    """
    kept = []
    for override in overrides:
        key = key_of(override)
        if kind_of(key).is_setting and (key, override.partition("=")[2]) != ("preset", preset):
            kept.append(override)
    return tuple(sorted(kept))


@dataclass(frozen=True)
class Run:
    """A job of a sweep and what its run left.

    Attributes:
        experiment: Such as `detector/basic`; None in a free grid.
        overrides: Of its task overrides, `settings`.
        seed: Its seed.
        directory: The run's directory; None for a job that never had one.
        status: `missing`: it is not said to have failed, but has no result.
        error: What a failed job died of.
        metrics: Test metrics without `test/`: millimetres, pixels and percent; NaN where a number was not finite.
        record: `record.json`, or nothing.
    """

    experiment: str | None
    overrides: tuple[str, ...]
    seed: int | None
    directory: Path | None
    status: Status
    error: str | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)

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
        return _mapping(self.record.get("data"))

    @property
    def picture(self) -> Path | None:
        """The page of its best, median and worst test samples."""
        path = None if self.directory is None else self.directory / "pictures" / "test_best_median_worst.png"
        return path if path is not None and path.is_file() else None

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """Its resolved configuration, or nothing."""
        try:
            assert self.directory is not None
            return _mapping(yaml.safe_load((self.directory / "config.yaml").read_text()))
        except (AssertionError, OSError, ValueError, yaml.YAMLError):
            return {}

    def setting(self, key: str) -> float | None:
        """A number of its configuration, such as `data.observation.num_points`; None where there is none."""
        value: Any = self.config
        for part in key.split("."):
            value = _mapping(value).get(part)
        return float(value) if isinstance(value, int | float) else None

    @cached_property
    def _csv_rows(self) -> list[dict[str, str]]:
        folder = None if self.directory is None else self.directory / "csv"
        if folder is None or not folder.is_dir():
            return []
        rows: list[dict[str, str]] = []
        for path in sorted(folder.glob("version_*/metrics.csv"), key=_version):
            try:
                with path.open(newline="") as file:
                    rows += list(csv.DictReader(file))
            except (OSError, ValueError, csv.Error):
                continue
        return rows

    def curve(self, metric: str) -> dict[int, float]:
        """The validation metric by epoch, counted from 1, over all attempts of the run.

        Args:
            metric: Without `val/`.
        """
        trained: set[int] = set()
        values: dict[int, float] = {}
        for row in self._csv_rows:
            epoch, value = _number(row.get("epoch")), _number(row.get(f"val/{metric}"))
            if epoch is None:
                continue
            if _number(row.get("train/loss")) is not None:
                trained.add(int(epoch))
            if value is not None:
                values[int(epoch)] = value
        # The best checkpoint's validation after the training is logged as one more epoch.
        return {epoch + 1: values[epoch] for epoch in sorted(values) if epoch in trained}

    def sample_errors(self, metric: str) -> tuple[np.ndarray, np.ndarray] | None:
        """The errors of its test samples.

        Args:
            metric: Of which metric.

        Returns:
            The samples `(S, 73)`, each its number and its true joints (metres, camera frame), by which samples of
            two runs can be told to be the same, and their errors `(S,)`, mm; None where there are none, or none of
            that metric.
        """
        if self.directory is None:
            return None
        try:
            with np.load(self.directory / "test_errors.npz") as arrays:
                errors = _errors(arrays, metric)
                ids, joints = arrays["sample_id"], arrays["joints"]
                samples = np.column_stack([ids, joints.reshape(len(ids), -1)])
                return None if errors is None else (samples, errors)
        except READ_ERRORS:
            return None


@dataclass(frozen=True)
class Sweep:
    """A sweep: `sweep.json` and its runs.

    Attributes:
        name: Such as `table_3_2`.
        preset: The sizes, such as `small`.
        tables: Names of the tables that it fills.
        command: What started it.
        runs: In the order of the jobs; of jobs of the same experiment, settings and seed, the first.
    """

    name: str
    preset: str
    tables: tuple[str, ...]
    command: str
    runs: tuple[Run, ...]


def read_sweep(directory: Path) -> Sweep:
    """A sweep and its runs.

    Args:
        directory: Holds `sweep.json`.

    Raises:
        FileNotFoundError: It does not.
        ValueError: That file is damaged.
    """
    path = directory / "sweep.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"directory: expected a sweep's directory with a sweep.json, got '{directory}'"
        )
    content = read_json(path)
    if content is None or not isinstance(content.get("jobs"), list):
        raise ValueError(
            f"'{path}': expected a JSON object with a list of jobs, got a damaged file; run the sweep again"
        )
    preset = str(content.get("preset") or "missing")
    runs: dict[Any, Run] = {}
    for job in content["jobs"]:
        run = _read_run(_mapping(job), directory, preset)
        runs.setdefault((run.experiment, run.overrides, run.seed), run)
    return Sweep(
        name=str(content.get("name") or directory.name),
        preset=preset,
        tables=tuple(str(name) for name in content.get("tables") or ()),
        command=str(content.get("command") or "missing"),
        runs=tuple(runs.values()),
    )


def _read_run(job: Mapping[str, Any], sweep: Path, preset: str) -> Run:
    directory = _locate(job.get("run_dir"), sweep)
    record = read_json(directory / "record.json") if directory else None
    metrics = _test_metrics(read_json(directory / "metrics.json") if directory else None)
    error = job.get("error") or (record or {}).get("error")
    status: Status = "complete"
    if job.get("status") == "failed" or (not metrics and (record or {}).get("status") == "failed"):
        status, metrics = "failed", {}
    elif not metrics:
        status = "missing"
    overrides = (str(override) for override in job.get("overrides") or ())
    return Run(
        experiment=None if job.get("experiment") is None else str(job["experiment"]),
        overrides=settings(overrides, preset),
        seed=job["seed"] if isinstance(job.get("seed"), int) else None,
        directory=directory,
        status=status,
        error=None if status == "complete" or error is None else str(error),
        metrics=metrics,
        record=record or {},
    )


def _locate(run_dir: Any, sweep: Path) -> Path | None:
    """A run's directory. A relative one is below the sweep's, or below one of the folders that hold that."""
    if not isinstance(run_dir, str) or not run_dir:
        return None
    places = [base / run_dir for base in (sweep, *sweep.absolute().parents)]  # an absolute one stays as it is
    return next((place for place in places if place.is_dir()), places[0])


def _test_metrics(content: Mapping[str, Any] | None) -> dict[str, float]:
    prefix = "test/"
    return {
        key.removeprefix(prefix): math.nan if value is None else float(value)
        for key, value in (content or {}).items()
        if key.startswith(prefix) and (value is None or isinstance(value, int | float))
    }


def _errors(arrays: Mapping[str, np.ndarray], metric: str) -> np.ndarray | None:
    """Errors `(S,)`, mm, of the metrics that are means over samples."""
    from ljn.body.skeleton import ROOT

    if metric == "apve":
        return arrays["apve_mm"]
    if metric == "mpjpe":
        return arrays["errors_mm"].mean(1)
    if metric == "initial_mpjpe":
        return arrays["initial_errors_mm"].mean(1)
    if metric == "mpjpe_eq38":
        errors = arrays["errors_mm"]
        return (errors.sum(1) - errors[:, ROOT]) / errors.shape[1]
    if metric == "mpjpe_root_aligned":
        pred, target = (arrays[name] - arrays[name][:, [ROOT]] for name in ("pred_joints", "joints"))
        return 1000 * np.linalg.norm(pred - target, axis=-1).mean(1)
    return None


def _version(path: Path) -> int:
    digits = path.parent.name.rpartition("_")[2]
    return int(digits) if digits.isdigit() else -1


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def varying(settings: Iterable[tuple[str, ...]]) -> frozenset[str]:
    """The overrides that some of these have and others have not."""
    sets: list[set[str]] = [set(overrides) for overrides in settings]
    return frozenset(sets[0].union(*sets) - sets[0].intersection(*sets)) if sets else frozenset()
