import json

import numpy as np
import pytest
from PIL import Image

from ljn.metrics import JointMetrics, MeshMetrics


class FakeSweep:
    """A sweep's directory, and runs in it as training leaves them."""

    def __init__(self, directory):
        self.directory = directory
        self.jobs = []

    def run(self, experiment, metrics, /, seed=0, overrides=(), errors=None, **changes):
        """A finished run: test metrics without `test/`; `errors` `(S,)`, the samples' `mpjpe_eq38`, mm."""
        folder = self.directory / "runs" / f"run-{len(self.jobs)}"
        (folder / "csv" / "version_0").mkdir(parents=True)
        (folder / "pictures").mkdir()
        content = {f"test/{name}": value for name, value in metrics.items()}
        (folder / "metrics.json").write_text(json.dumps(content))
        stage = MESH if "apve" in metrics else {}
        (folder / "record.json").write_text(json.dumps(RECORD | stage | changes))
        (folder / "config.yaml").write_text("data: {observation: {num_points: 512}}\n")
        main = "apve" if "apve" in metrics else "mpjpe_eq38"
        lines = [f"epoch,step,train/loss,val/{main},val/mpjpe"]
        for epoch in range(3):
            lines += [f"{epoch},{epoch},,{90 - epoch},{95 - epoch}", f"{epoch},{epoch},0.5,,"]
        lines.append("3,3,,88,93")  # the best checkpoint's validation after the training
        (folder / "csv" / "version_0" / "metrics.csv").write_text("\n".join(lines) + "\n")
        picture = Image.new("RGB", (2000, 100), (200, 60, 60))
        picture.save(folder / "pictures" / "test_best_median_worst.png")
        if errors is not None:
            samples = {"sample_id": np.arange(len(errors)), "joints": np.zeros((len(errors), 24, 3))}
            np.savez(folder / "test_errors.npz", **samples, mpjpe_eq38=errors)
        self.job(experiment, seed, overrides, run_dir=str(folder))
        return folder

    def job(self, experiment, seed=0, overrides=(), run_dir=None, status="complete", error=None):
        typed = [*([f"experiment={experiment}"] if experiment else []), f"seed={seed}", *overrides]
        self.jobs.append(
            {"experiment": experiment, "overrides": typed, "seed": seed}
            | {"run_dir": run_dir, "status": status, "error": error}
        )

    def write(self, *tables, **changes):
        content = {"name": "sweep", "preset": "small", "tables": list(tables), "command": "python run.py"}
        (self.directory / "sweep.json").write_text(json.dumps(content | {"jobs": self.jobs} | changes))
        return self.directory


MESH = {"stage": "mesh", **MeshMetrics.describe()}
RECORD = {
    "stage": "detector",
    **JointMetrics.describe(),
    "truth": ["joints"],
    "is_root_relative": False,
    **{"status": "complete", "preset": "small", "config_hash": "c0ffee12"},
    **{"commit": "0123456789abcdef", "is_dirty": True},
    "versions": {"python": "3.11.7", "torch": "2.7.0"},
    "device": "cpu",
    "started": "2026-01-02T03:04:05+00:00",
    "wall_time_s": 3725.0,
    "num_parameters": 1006757,
    "data": {
        "source": "embedded",
        "version": 1,
        "fingerprint": "feed5eed",
        "licence": "CC0",
        "sizes": {"train": 12000, "val": 500, "test": 2000},
        "motion": {
            "train": {"clips": 13, "frames": 2129},
            "val": {"clips": 4, "frames": 258},
            "test": {"clips": 5, "frames": 1238},
        },
        "pool": {"train": "aaaa1111", "val": "bbbb2222", "test": "cccc3333"},
        "bodies": {"female": "dddd4444", "male": "eeee5555"},
        "detector": {"path": "outputs/runs/detector/checkpoints/best.ckpt", "hash": "d37ec70rd37ec70r"},
        "seeds": {"seed": 0},
    },
}


@pytest.fixture
def sweep(tmp_path):
    return FakeSweep(tmp_path)


@pytest.fixture
def table_3_2(sweep):
    """Table 3.2 with two seeds of each row, ordered as in the thesis, and a row that failed."""
    for seed, more in enumerate((0.0, 1.0)):
        sweep.run("detector/basic", {"mpjpe_eq38": 90 + more, "pckh": 40 - more}, seed)
        sweep.run("detector/no_edm", {"mpjpe_eq38": 70 + more, "pckh": 52 - more}, seed)
        sweep.run("detector/proposed", {"mpjpe_eq38": 60 + more, "pckh": 55 - more}, seed)
        aligned = {"mpjpe_root_aligned": 100 + more, "pckh_root_aligned": 30 - more}
        sweep.run("detector/simple_baseline_0px", {"mpjpe_eq38": 999.0, "pckh": 1.0, **aligned}, seed)
    error = "ValueError: <script>alert(1)</script> & more_text"
    sweep.job("detector/simple_baseline", status="failed", error=error)
    return sweep.write("table_3_2")
