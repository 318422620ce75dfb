import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def python(*arguments, **options):
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300, **options
    )


@pytest.mark.parametrize(
    ("argument", "printed"), [("--help", "keypoint_noise_px: 10"), ("task=list", "mesh/proposed")]
)
def test_what_only_prints_loads_nothing_heavy(argument, printed):
    code = (
        f"import sys; sys.argv = ['run.py', {argument!r}]\nimport runpy\n"
        "try: runpy.run_path('run.py', run_name='__main__')\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'lightning', 'numba', 'wandb', 'matplotlib', 'open3d'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout


def test_importing_the_package_stays_cheap():
    code = (
        "import sys, ljn, ljn.report\n"
        "heavy = {'torch', 'hydra', 'omegaconf', 'matplotlib', 'numba'} & set(sys.modules)\nassert not heavy, heavy\n"
        "ljn.SMPL, ljn.JointDetector, ljn.get_renderer, ljn.Camera\n"
        "heavy = {'open3d', 'pyrender', 'wandb', 'numba'} & set(sys.modules)\nassert not heavy, heavy\n"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


def test_a_misspelt_key_is_named_before_anything_starts():
    done = python("run.py", "data.num_pionts=3")
    assert done.returncode != 0
    assert "num_pionts" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_key_that_the_task_would_not_see_is_named():
    done = python("run.py", "task=figures", "refine=true")
    assert done.returncode == 1
    assert (
        "refine: task=figures does not read it; leave it out, or choose one of the tasks predict"
        in done.stderr
    )


def test_a_user_error_is_one_message_without_a_traceback(tmp_path):
    done = python("run.py", "model.radii_m=[0.2]", f"paths.output_dir={tmp_path}")
    assert done.returncode == 1
    assert "model.radii_m: expected 24 radii" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_demo_sweep_runs_every_row_and_one_that_fails_costs_the_others_nothing(tmp_path):
    done = python(
        *("run.py", "sweep=demo", f"paths.output_dir={tmp_path}", "preset.num_train=32", "preset.num_val=8"),
        *("preset.num_test=16", "preset.max_epochs=1", "preset.num_points=128", "data.num_workers=0"),
        *("preset.group_size=0", "callbacks.pictures=null"),
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 1
    sweep = tmp_path / "sweeps" / "demo"
    for name in ("table.csv", "table.md", "table.tex", "report.html"):
        assert (sweep / name).stat().st_size > 100
    jobs = json.loads((sweep / "sweep.json").read_text())["jobs"]
    failed = {job["experiment"]: job for job in jobs if job["status"] == "failed"}
    assert failed.keys() == {"detector/proposed"}
    assert "group_size: expected" in failed["detector/proposed"]["error"]
    assert re.search(r"proposed.*failed", done.stdout, re.IGNORECASE)
    for label in ("initial joints", "mean offset", "ridge", "basic"):
        assert re.search(rf"^\W*{label}.*\d", done.stdout, re.MULTILINE | re.IGNORECASE), label
    # A W&B run of its own for each job and for the table, offline.
    assert len(list(sweep.glob("wandb/offline-run-*/run-*.wandb"))) == 1, done.stderr
    complete = [tmp_path / job["run_dir"] for job in jobs if job["status"] == "complete"]
    assert len(complete) == 3
    for run in complete:
        assert json.loads((run / "record.json").read_text())["status"] == "complete"
        assert json.loads((run / "metrics.json").read_text())["test/mpjpe"] > 0
        assert len(list(run.glob("wandb/offline-run-*/run-*.wandb"))) == 1
