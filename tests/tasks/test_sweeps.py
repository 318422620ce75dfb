import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ljn.report.tables import TABLES
from ljn.runs.files import read_json
from ljn.runs.identity import config_hash, identity

ROOT = Path(__file__).parents[2]
SWEEPS = {path.stem: OmegaConf.load(path) for path in (ROOT / "conf" / "sweep").glob("*.yaml")}
OF_TABLES = sorted(name for name, sweep in SWEEPS.items() if "tables" in sweep)
NUM_TRAININGS = 17
"""Distinct configurations behind all tables."""


def experiments(name):
    return [row.strip() for row in SWEEPS[name].hydra.sweeper.params.experiment.split(",")]


@pytest.mark.parametrize("name", OF_TABLES)
def test_a_sweep_runs_the_rows_of_its_tables(name):
    rows = {row.experiment for table in SWEEPS[name].tables for row in TABLES[table].rows} - {None}
    assert sorted(experiments(name)) == sorted(rows)


def test_every_table_has_a_sweep_and_all_of_the_thesis_are_in_all_tables():
    assert set(TABLES) == {table for name in OF_TABLES for table in SWEEPS[name].tables}
    assert set(SWEEPS["all_tables"].tables) == set(TABLES) - {"demo", "backgrounds"}


@pytest.mark.slow
def test_all_tables_train_each_distinct_configuration_once(smoke_config, tmp_path):
    configs = {name: smoke_config(tmp_path, f"experiment={name}") for name in experiments("all_tables")}
    hashes = {}
    for experiment, cfg in configs.items():
        if cfg.task._target_.endswith("train"):
            hashes[experiment] = config_hash(identity(cfg, "the same data"))
        else:
            trained = configs[cfg.task.trains]
            # What an evaluation trains is another row's run.
            same = [cfg[group] == trained[group] for group in ("data", "model", "module", "trainer", "seed")]
            assert all(same), experiment
            assert cfg.task.detector in (None, *configs)
    assert len(hashes) == len(set(hashes.values())) == NUM_TRAININGS


SIZES = (
    "preset=smoke", "logger=csv", "data.num_workers=0", "callbacks.pictures=null", "preset.num_train=16",
    "preset.num_val=4", "preset.num_test=8", "preset.max_epochs=1",
)  # fmt: skip


def run_sweep(directory, *overrides):
    command = [
        sys.executable,
        "run.py",
        "sweep=table_3_4",
        *SIZES,
        f"paths.output_dir={directory}",
        *overrides,
    ]
    options = {"env": os.environ | {"OMP_NUM_THREADS": "1"}, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.STDOUT, **options)


def numbers(directory):
    """The metrics of each job of the sweep."""
    sweep = json.loads((directory / "sweeps" / "table_3_4-smoke" / "sweep.json").read_text())
    return {
        (job["experiment"], job["seed"]): read_json(directory / job["run_dir"] / "metrics.json")
        for job in sweep["jobs"]
    }


@pytest.mark.slow
def test_a_killed_sweep_is_finished_by_the_same_command_with_the_same_table(tmp_path):
    whole = run_sweep(tmp_path / "whole", "seed=0,1")
    assert whole.wait(timeout=300) == 0

    def end(number, num_started):
        """Start the sweep, and send it a signal while it is at the run of this number; the runs that it has begun."""
        sweep = run_sweep(tmp_path / "killed", "seed=0,1")
        started = []
        while len(started) < num_started and sweep.poll() is None:
            started = list((tmp_path / "killed" / "runs").glob("*/record.json"))
            time.sleep(0.1)
        sweep.send_signal(number)
        output = sweep.communicate(timeout=60)[0]
        return started, sweep.returncode, output

    started, returncode, output = end(signal.SIGTERM, 1)
    assert returncode == 143, output
    assert [read_json(path)["status"] for path in started] == ["interrupted"]
    page = tmp_path / "killed" / "sweeps" / "table_3_4-smoke" / "report.html"
    assert "missing" in page.read_text()
    started, *_ = end(signal.SIGKILL, 3)
    complete = [path for path in started if read_json(path)["status"] == "complete"]
    assert len(started) == 3
    assert len(complete) == 2
    before = {path: path.stat().st_mtime_ns for path in complete}

    again = run_sweep(tmp_path / "killed", "seed=0,1")
    output = again.communicate(timeout=300)[0]
    assert again.returncode == 0, output
    assert output.count("is complete; train it again") == 2
    assert {path: path.stat().st_mtime_ns for path in complete} == before
    assert numbers(tmp_path / "killed") == numbers(tmp_path / "whole")
    table = "sweeps/table_3_4-smoke/table.md"
    assert (tmp_path / "killed" / table).read_text() == (tmp_path / "whole" / table).read_text()


@pytest.mark.slow
def test_the_chain_takes_the_detector_and_the_mesh_regressor_of_the_other_rows(run_py, tmp_path):
    rows = "experiment=mesh/proposed,mesh/chain"
    done = run_py("sweep=table_3_6", *SIZES, rows, f"paths.output_dir={tmp_path}")
    assert "2 jobs: 1 runs, 1 evaluations" in done.stdout
    runs = {path.name.rpartition("-smoke")[0] for path in (tmp_path / "runs").iterdir()}
    assert runs == {"detector-proposed", "mesh-proposed"}
    [record] = [json.loads(path.read_text()) for path in (tmp_path / "evaluations").glob("*/record.json")]
    [detector] = (tmp_path / "runs").glob("detector-proposed-*/checkpoints/best.ckpt")
    assert record["data"]["detector"]["path"] == str(detector)
    assert record["trained_by"].startswith("mesh-proposed-smoke-")
