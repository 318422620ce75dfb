"""A sweep's results side by side: tables and a page, on disk, on the terminal and in the tracker."""

import atexit
import csv
import logging
import os
import shlex
import sys
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from ljn.report import write_report
from ljn.runs import layout
from ljn.runs.files import path_part, read_json, write_json
from ljn.runs.sweep import job_of, read_jobs, settings
from ljn.tasks.processes import sweep_name

_LOG = logging.getLogger(__name__)


class SweepReport(Callback):
    """Hydra callback: gathers a multirun's runs in `output_dir/sweeps/NAME-PRESET` and writes their tables.

    After every job, so that neither a failure nor a kill costs what is there: `sweep.json`, which names the runs, and
    the tables as files. At the end also `report.html`, and the tables are printed. Each job leaves a note in Hydra's
    sweep directory, since jobs may run in processes of their own.
    """

    def __init__(self, output_dir: str | Path) -> None:
        self.output_dir = Path(output_dir)
        self._sweep: DictConfig | None = None

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note that a job runs: so it stays, without a result, where the sweep ends in the middle of it."""
        if config.hydra.mode == RunMode.MULTIRUN and _has_table(config):
            self._note(config, run_dir=None, status="running", error=None)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Note what became of a job; write the tables of all so far."""
        if config.hydra.mode != RunMode.MULTIRUN or not _has_table(config):
            return
        assert job_return.cfg is not None
        run_dir = self._relative(job_return.cfg.paths.run_dir)
        if job_return.status == JobStatus.COMPLETED:
            self._note(config, run_dir=run_dir, status="complete", error=None)
            self._warn_of_equal(config)
        else:
            error = job_return._return_value  # reading `return_value` would raise it
            self._note(config, run_dir=run_dir, status="failed", error=f"{type(error).__name__}: {error}")
        write_report(self._gather(config), is_final=False)
        self._sum_up_at_exit()

    def _warn_of_equal(self, config: DictConfig) -> None:
        """Say if this job has other values than an earlier one of its experiment, but found the earlier one's run."""
        number, notes = int(config.hydra.job.num), self._notes(config)
        this, *others = (
            job_of(read_json(path) or {})
            for path in (notes / f"{number:04d}.json", *sorted(notes.glob("*.json")))
        )
        for other in others:
            differing = set(this["overrides"]) - set(other["overrides"])
            is_same = all(this[key] == other[key] for key in ("run_dir", "experiment", "seed"))
            if this["run_dir"] and is_same and differing and other["status"] == "complete":
                _LOG.warning(
                    "job %d is the same run as one before it: nothing of its experiment depends on %s; leave that out "
                    "of the sweep, or choose a key that the experiment reads",
                    *(number, ", ".join(sorted(differing))),
                )
                return

    def _note(self, config: DictConfig, **outcome: str | None) -> None:
        """Write a job's note, which takes the place of an earlier one."""
        notes = self._notes(config)
        notes.mkdir(parents=True, exist_ok=True)
        experiment, overrides = (
            config.hydra.runtime.choices.get("experiment"),
            list(config.hydra.overrides.task),
        )
        job = {"experiment": experiment, "overrides": overrides, "seed": config.seed}
        write_json(notes / f"{int(config.hydra.job.num):04d}.json", job | outcome)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make sure that the sweep is summed up however it ends."""
        # No copy: a copy's `now` is another time, and its directory another one.
        self._sweep = config
        config.group = config.group or sweep_name(config.hydra)
        self._sum_up_at_exit()

    def _sum_up_at_exit(self) -> None:
        """After a failed job, Hydra does not call `on_multirun_end`."""
        if self._sweep is not None:  # in the process that runs the sweep
            # Again after every job: what is registered last is called first, while the tracker still works.
            atexit.unregister(self._sum_up)
            atexit.register(self._sum_up)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Sum the sweep up."""
        atexit.unregister(self._sum_up)
        try:
            self._sum_up()
        except Exception as error:
            # Hydra would make a warning of it, and the call would have gone well.
            raise SystemExit(
                f"error: the runs are there, but not their tables: {type(error).__name__}: {error}"
            ) from error

    def _sum_up(self) -> None:
        """Write and print the tables of all jobs, and the page; log the table to the tracker."""
        if self._sweep is None or not self._notes(self._sweep).is_dir():  # not one job was started
            return
        directory = self._gather(self._sweep)
        report = write_report(directory)
        jobs = read_jobs(directory)
        directories = {str(job["run_dir"]) for job in jobs if job["run_dir"]}
        num_runs = sum(run.startswith("runs") for run in directories)
        num_evaluations = len(directories) - num_runs
        print(f"\n{report.text}\n\n{len(jobs)} jobs: {num_runs} runs, {num_evaluations} evaluations")
        print("\n".join(map(str, report.paths)), flush=True)
        # Not above: Hydra imports this file for every call, also for one that should not load PyTorch.
        from ljn.tasks.tracking import log_table

        with (directory / layout.TABLE_CSV).open(newline="", encoding="utf-8") as file:
            rows = [{name: _as_number(value) for name, value in row.items()} for row in csv.DictReader(file)]
        log_table(directory.name, rows, self._sweep.logger, directory)

    def _notes(self, config: DictConfig) -> Path:
        return Path(config.hydra.sweep.dir) / "jobs"

    def _gather(self, config: DictConfig) -> Path:
        """Write `sweep.json` from the jobs' notes; returns its directory."""
        name, preset = sweep_name(config.hydra), config.preset.name
        parts = dict.fromkeys([path_part(name), path_part(preset)])  # once where they are the same
        directory = self.output_dir / "sweeps" / "-".join(parts)
        directory.mkdir(parents=True, exist_ok=True)
        notes = [job_of(note) for note in map(read_json, sorted(self._notes(config).glob("*.json"))) if note]
        # What earlier calls have done stays in the tables: other seeds, and what this call has not reached or has
        # not finished; what failed, among this call's rows.
        earlier = read_jobs(directory)
        done = {_key(job, preset) for job in earlier if job["status"] == "complete"}
        jobs = [note for note in notes if note["status"] != "running" or _key(note, preset) not in done]
        known = {_key(job, preset) for job in jobs}
        rows = {row for row, _ in known}
        for job in earlier:
            row, seed = _key(job, preset)
            if (row, seed) not in known and (job["status"] == "complete" or row in rows):
                jobs.append(job)
        command = shlex.join(["python", "run.py", *sys.argv[1:]])
        content = {
            "name": name,
            "preset": preset,
            "tables": list(config.tables),
            "command": command,
            "jobs": jobs,
        }
        write_json(directory / layout.SWEEP, content)
        return directory

    def _relative(self, run_dir: str | None) -> str | None:
        """A run's directory as seen from `output_dir`, so that the whole output can be moved."""
        return None if run_dir is None else os.path.relpath(run_dir, self.output_dir)


def _has_table(config: DictConfig) -> bool:
    """Whether the jobs' task gives the metrics that a table is of."""
    return config.hydra.runtime.choices.get("task", "train") in ("train", "evaluate", "cross")


def _key(job: dict[str, Any], preset: str) -> tuple[tuple[Any, ...], Any]:
    """What tells a job from others: its row, which jobs share that differ in their seeds alone, and its seed."""
    return (job["experiment"], settings(job["overrides"], preset)), job["seed"]


def _as_number(value: str) -> float | str:
    try:
        return float(value)
    except ValueError:
        return value
