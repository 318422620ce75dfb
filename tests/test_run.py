import json
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def python(*arguments, **options):
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300, **options
    )


def test_help_prints_the_config_and_loads_nothing_heavy():
    code = (
        "import sys; sys.argv = ['run.py', '--help']\nimport runpy\n"
        "try: runpy.run_path('run.py', run_name='__main__')\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'lightning', 'numba', 'wandb', 'matplotlib', 'open3d'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert "experiment/detector: basic" in done.stdout
    assert "keypoint_noise_px: 10" in done.stdout


def test_importing_the_package_stays_cheap():
    code = (
        "import sys, ljn\n"
        "heavy = {'torch', 'open3d', 'pyrender', 'wandb', 'numba'} & set(sys.modules)\nassert not heavy, heavy\n"
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


def test_a_user_error_is_one_message_without_a_traceback(tmp_path):
    done = python("run.py", "model.radii_m=[0.2]", f"paths.output_dir={tmp_path}")
    assert done.returncode == 1
    assert "model.radii_m: expected 24 radii" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_demo_sweep_runs_every_row_and_sums_up(tmp_path):
    done = python(
        *("run.py", "sweep=demo", f"paths.output_dir={tmp_path}", "preset.num_train=32", "preset.num_val=8"),
        *("preset.num_test=16", "preset.max_epochs=1", "preset.num_points=128", "data.num_workers=0"),
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    sweep = tmp_path / "sweeps" / "demo"
    for name in ("sweep.json", "table.csv", "table.md", "table.tex", "report.html"):
        assert (sweep / name).stat().st_size > 100
    for label in ("initial joints", "mean offset", "ridge", "basic", "proposed"):
        assert re.search(rf"^\W*{label}.*\d", done.stdout, re.MULTILINE | re.IGNORECASE), label
    runs = list((tmp_path / "runs").iterdir())
    assert len(runs) == 4
    assert "failed" not in done.stdout.lower()
    for run in runs:
        assert json.loads((run / "record.json").read_text())["status"] == "complete"
        # A W&B run of its own for each job, offline.
        assert len(list(run.glob("wandb/offline-run-*/run-*.wandb"))) == 1


def test_a_failing_job_costs_the_others_nothing_and_is_printed_as_failed(tmp_path):
    done = python(
        *("run.py", "sweep=demo", "preset=smoke", f"paths.output_dir={tmp_path}", "data.num_workers=0"),
        *("preset.num_train=32", "preset.num_val=8", "preset.num_test=16", "preset.max_epochs=1"),
        *("experiment=detector/mean_offset,detector/proposed,detector/basic", "preset.group_size=0"),
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 1
    jobs = json.loads((tmp_path / "sweeps" / "demo" / "sweep.json").read_text())["jobs"]
    assert [job["status"] for job in jobs] == ["complete", "failed", "complete"]
    assert "group_size: expected" in jobs[1]["error"]
    assert re.search(r"proposed.*failed", done.stdout, re.IGNORECASE)
    assert len(list(tmp_path.glob("sweeps/demo/wandb/offline-run-*/run-*.wandb"))) == 1, done.stderr
    for job in jobs[::2]:
        assert json.loads((tmp_path / job["run_dir"] / "metrics.json").read_text())["test/mpjpe"] > 0
