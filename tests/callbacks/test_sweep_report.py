import json

import pytest
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from omegaconf import OmegaConf

from callbacks.sweep_report import SweepReport


@pytest.fixture
def end_job(tmp_path):
    """Let a job of a call end; returns the jobs that `sweep.json` then names."""

    def end(call, number, run_dir, status=JobStatus.COMPLETED):
        hydra = {
            "mode": RunMode.MULTIRUN,
            "overrides": {"task": [f"seed={number}"]},
            "runtime": {"choices": {"experiment": "detector/proposed", "sweep": "table_3_4"}},
            "sweep": {"dir": str(tmp_path / "multirun" / call)},
            "job": {"num": number},
        }
        run = {"seed": number, "paths": {"run_dir": str(tmp_path / "runs" / run_dir)}}
        config = OmegaConf.create({"hydra": hydra, "preset": {"name": "smoke"}, "tables": ["table_3_4"]})
        returned = JobReturn(cfg=OmegaConf.create(run), status=status)
        returned.return_value = ValueError("broken") if status == JobStatus.FAILED else None
        SweepReport(tmp_path).on_job_end(config, returned)
        return json.loads((tmp_path / "sweeps" / "table_3_4-smoke" / "sweep.json").read_text())["jobs"]

    return end


def test_a_later_call_keeps_what_earlier_ones_have_done(end_job):
    end_job("first", 0, "a")
    end_job("first", 1, "b")
    jobs = end_job("second", 0, "a")
    assert sorted(job["run_dir"] for job in jobs) == ["runs/a", "runs/b"]
    jobs = end_job("third", 0, "c")
    assert sorted(job["run_dir"] for job in jobs) == ["runs/a", "runs/b", "runs/c"]


def test_failures_of_earlier_calls_are_forgotten_and_those_of_this_one_count(end_job):
    end_job("first", 0, "a", JobStatus.FAILED)
    jobs = end_job("second", 1, "b")
    assert [job["run_dir"] for job in jobs] == ["runs/b"]
    [job] = end_job("third", 1, "b", JobStatus.FAILED)
    assert (job["status"], job["error"]) == ("failed", "ValueError: broken")
