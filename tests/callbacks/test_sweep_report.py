import atexit
import json

import pytest
from hydra._internal.callbacks import Callbacks
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf

from callbacks.sweep_report import SweepReport


@pytest.fixture
def end_job(tmp_path):
    """Let a job of a call end; returns the jobs that `sweep.json` then names."""

    def end(call, number, run_dir, status=JobStatus.COMPLETED, typed=(), seed=None, task="train"):
        """With no status, the sweep ends in the middle of the job."""
        hydra = {
            "mode": RunMode.MULTIRUN,
            "overrides": {"task": [f"seed={number if seed is None else seed}", *typed]},
            "runtime": {"choices": {"experiment": "detector/proposed", "sweep": "table_3_4", "task": task}},
            "sweep": {"dir": str(tmp_path / "multirun" / call)},
            "job": {"num": number},
        }
        seed = number if seed is None else seed
        content = {"seed": seed, "preset": {"name": "smoke"}, "tables": ["table_3_4"], "logger": None}
        config = OmegaConf.create({"hydra": hydra, "group": None, **content})
        report = SweepReport(tmp_path)
        report.on_job_start(config)
        if status is None:
            report.on_multirun_start(config)
            atexit.unregister(report._sum_up)
            report._sum_up()
        else:
            run = {"paths": {"run_dir": str(tmp_path / "runs" / run_dir)}}
            returned = JobReturn(cfg=OmegaConf.create(run), status=status)
            returned.return_value = ValueError("broken") if status == JobStatus.FAILED else None
            report.on_job_end(config, returned)
        index = tmp_path / "sweeps" / "table_3_4-smoke" / "sweep.json"
        return json.loads(index.read_text())["jobs"] if index.is_file() else []

    return end


def test_a_later_call_keeps_what_earlier_ones_have_done(end_job):
    end_job("first", 0, "a")
    end_job("first", 1, "b")
    jobs = end_job("second", 2, "c")
    assert sorted(job["run_dir"] for job in jobs) == ["runs/a", "runs/b", "runs/c"]


def test_a_damaged_index_of_earlier_jobs_stops_nothing(end_job, tmp_path):
    end_job("first", 0, "a")
    index = tmp_path / "sweeps" / "table_3_4-smoke" / "sweep.json"
    for content in ("[", '{"jobs": 3}', '{"jobs": [3, {}, {"seed": [], "overrides": 1, "run_dir": {}}]}'):
        index.write_text(content)
        assert "runs/b" in [job["run_dir"] for job in end_job("second", 1, "b")]


def test_a_seed_that_ran_again_takes_the_place_of_the_earlier_run(end_job):
    end_job("first", 0, "a")
    end_job("first", 1, "b")
    jobs = end_job("second", 0, "with-another-hash", typed=("num_threads=1", "paths.output_dir=elsewhere"))
    assert sorted(job["run_dir"] for job in jobs) == ["runs/b", "runs/with-another-hash"]
    jobs = end_job("third", 0, "c", typed=("data.observation.num_points=64",))
    assert len(jobs) == 3, "another row"


def test_a_swept_key_that_changes_nothing_is_said(end_job, caplog):
    end_job("first", 0, "a", seed=0, typed=("preset.mesh.learning_rate=1",))
    assert not caplog.messages
    end_job("first", 1, "a", seed=0, typed=("preset.mesh.learning_rate=2",))
    assert "nothing of its experiment depends on preset.mesh.learning_rate=2" in caplog.text
    caplog.clear()
    end_job("first", 2, "b", seed=0, typed=("data.observation.num_points=2",))
    end_job("second", 0, "a", seed=0, typed=("preset.mesh.learning_rate=1",))
    assert not caplog.messages


def test_a_multirun_of_predictions_has_no_table(end_job, tmp_path):
    assert end_job("first", 0, "a", task="predict") == []
    assert end_job("second", 0, "a", status=None, task="predict") == []
    assert not (tmp_path / "sweeps").exists()


def test_a_failure_is_kept_among_the_rows_of_a_later_call_until_it_is_mended(end_job):
    end_job("first", 0, "a", JobStatus.FAILED)
    end_job("first", 1, "b")
    jobs = end_job("second", 2, "c")
    assert [(job["seed"], job["status"]) for job in jobs] == [(2, "complete"), (0, "failed"), (1, "complete")]
    jobs = end_job("third", 0, "a")
    assert {job["status"] for job in jobs} == {"complete"}
    [job, *_] = end_job("fourth", 1, "b", JobStatus.FAILED)
    assert (job["status"], job["error"]) == ("failed", "ValueError: broken")


def test_a_failure_with_other_settings_is_forgotten(end_job):
    end_job("first", 0, "a", JobStatus.FAILED, typed=("data.observation.num_points=0",))
    assert len(end_job("second", 0, "b", typed=("data.observation.num_points=64",))) == 1


def test_a_sweep_that_ends_in_the_middle_of_a_job_leaves_tables(end_job, tmp_path):
    [job] = end_job("first", 0, "a", status=None)
    assert (job["seed"], job["run_dir"], job["status"]) == (0, None, "running")
    assert "missing" in (tmp_path / "sweeps" / "table_3_4-smoke" / "table.md").read_text()
    [job] = end_job("second", 0, "a")
    assert job["status"] == "complete"
    [job] = end_job("third", 0, "a", status=None)
    assert job["status"] == "complete", "the earlier result stays until there is another"


def test_tables_that_cannot_be_written_end_the_call_as_failed(tmp_path, monkeypatch):
    def broken(self):
        raise OSError("no space left")

    monkeypatch.setattr(SweepReport, "_sum_up", broken)
    callbacks = Callbacks()
    callbacks.callbacks = [SweepReport(tmp_path)]
    with pytest.raises(SystemExit, match="not their tables: OSError: no space left"):
        callbacks.on_multirun_end(config=OmegaConf.create())
