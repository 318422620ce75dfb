import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Callback
from omegaconf import OmegaConf

from datamodules.batches import EpochSampler
from ljn.building import build
from ljn.metrics import JointMetrics
from ljn.runs.files import read_json
from ljn.runs.identity import config_hash, identity
from ljn.tasks import running
from ljn.tasks import train as train_task
from ljn.tasks.running import set_run_directory
from ljn.tasks.train import train

ROOT = Path(__file__).parents[2]


def weights(run_dir):
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def test_a_run_leaves_its_files(trained):
    metrics, run_dir = trained
    assert set(metrics) == {f"{split}/{name}" for split in ("val", "test") for name in JointMetrics.table}
    assert json.loads((run_dir / "metrics.json").read_text()) == metrics
    record = json.loads((run_dir / "record.json").read_text())
    assert record["status"] == "complete"
    assert (record["stage"], record["headline"]) == ("detector", ["mpjpe", "pckh"])
    assert (record["truth"], record["is_root_relative"]) == (["joints"], False)
    assert record["metrics"]["pckh"] == {"unit": "%", "goal": "max"}
    assert record["config_hash"] == run_dir.name.rpartition("-")[2]
    assert record["data"]["sizes"] == {"train": 32, "val": 16, "test": 16}
    assert set(record["data"]["bodies"]) == {"female", "male"}
    assert set(record["data"]["pool"]) == {"train", "val", "test"}
    assert record["data"]["seeds"] == {"seed": 0, "pool_seed": 0, "eval_seed": 0}
    assert OmegaConf.load(run_dir / "config.yaml").data.observation.num_points == 128
    assert (run_dir / "checkpoints" / "best.ckpt").is_file()
    pictures = {path.stem for path in (run_dir / "pictures").iterdir()}
    assert pictures == {"test_best_median_worst", "val_epoch_001", "val_epoch_002"}
    with (run_dir / "csv" / "version_0" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    # Two epochs, and the best checkpoint at the end.
    assert len([row for row in rows if row["val/mpjpe"]]) == 3
    assert rows[-1]["test/mpjpe"]


def test_the_errors_of_kinds_of_samples_add_up_to_the_whole(trained):
    metrics, run_dir = trained
    with (run_dir / "test_groups.csv").open() as file:
        rows = list(csv.DictReader(file))
    for by in ("pose", "heading"):
        kinds = [row for row in rows if row["by"] == by]
        total = sum(int(row["samples"]) * float(row["mpjpe"]) for row in kinds)
        assert sum(int(row["samples"]) for row in kinds) == 16
        assert total / 16 == pytest.approx(metrics["test/mpjpe"], abs=1e-2)
    assert {row["kind"] for row in rows if row["by"] == "heading"} <= {"facing", "sideways", "away"}


def test_stored_samples_give_the_metrics_again(trained):
    metrics, run_dir = trained
    with np.load(run_dir / "test_errors.npz") as arrays:
        assert arrays["pred_joints"].shape == arrays["joints"].shape == (16, 24, 3)
        for name in JointMetrics.table:
            values = arrays[name]
            assert (values.shape, values.dtype) == ((16,), np.float64)
            whole = values.max() if "max" in name else values.mean()
            assert whole == pytest.approx(metrics[f"test/{name}"], rel=1e-6)  # logged in float32
        distance = np.linalg.norm(arrays["pred_joints"] - arrays["joints"], axis=-1)
        np.testing.assert_allclose(1000 * distance.mean(1), arrays["mpjpe"], rtol=1e-4)


def test_a_complete_run_is_not_trained_again(trained, smoke_config, monkeypatch):
    metrics, run_dir = trained
    monkeypatch.setattr(train_task, "build_trainer", lambda *_: pytest.fail("trained again"))
    cfg = smoke_config(run_dir.parents[1], "experiment=detector/proposed", "data.num_workers=1")
    assert train(cfg) == metrics


@pytest.fixture
def add_callback(monkeypatch):
    """Let a run have one more callback."""
    original = running.build_each

    def add(callback):
        more = lambda node: [*original(node), *([callback] if "best" in node else [])]  # noqa: E731
        monkeypatch.setattr(running, "build_each", more)

    return add


class Seen(Callback):
    """Keeps the samples of every step."""

    def __init__(self):
        self.samples = []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.samples.append((trainer.current_epoch, batch["sample_id"].tolist()))


def test_the_same_seed_gives_the_same_run_and_samples_whatever_the_workers(
    trained, smoke_config, tmp_path, add_callback
):
    metrics, run_dir = trained
    other = ("data.num_workers=2", "callbacks.pictures=null")
    cfg = smoke_config(tmp_path, "experiment=detector/proposed", *other)
    add_callback(seen := Seen())
    assert train(cfg) == metrics
    ours, theirs = weights(run_dir), weights(Path(cfg.paths.run_dir))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    expected = []
    for epoch in range(2):
        order = [index for _, index in EpochSampler(32, seed=0, epoch=epoch)]
        expected += [(epoch, order[start : start + 8]) for start in range(0, 32, 8)]
    assert seen.samples == expected


class Stop(Callback):
    """Breaks a run off in the middle of an epoch, as a crash would."""

    def __init__(self, epoch):
        self.epoch = epoch

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if trainer.current_epoch == self.epoch and batch_idx == 1:
            raise RuntimeError("power cut")


RESUMED = (
    "trainer.max_epochs=3",
    "preset.scheduler.step_size=1",
    "preset.scheduler.gamma=0.5",
    "callbacks.pictures=null",
)


@pytest.fixture(scope="module")
def uninterrupted(smoke_config, tmp_path_factory):
    """Metrics and weights of an experiment's run without workers, trained once."""

    @cache
    def run(experiment):
        cfg = smoke_config(tmp_path_factory.mktemp("whole"), f"experiment={experiment}", *RESUMED)
        return train(cfg), weights(Path(cfg.paths.run_dir))

    return run


@pytest.mark.parametrize(
    ("experiment", "epoch", "num_workers"),
    [
        ("detector/proposed", 2, 0),
        pytest.param("detector/proposed", 1, 1, marks=pytest.mark.slow),
        pytest.param("detector/proposed", 2, 2, marks=pytest.mark.slow),
        ("detector/simple_baseline", 2, 1),  # with dropout
    ],
)
def test_a_resumed_run_equals_an_uninterrupted_one(
    uninterrupted, smoke_config, tmp_path, add_callback, experiment, epoch, num_workers
):
    cfg = smoke_config(tmp_path, f"experiment={experiment}", *RESUMED, f"data.num_workers={num_workers}")
    add_callback(Stop(epoch))
    with pytest.raises(RuntimeError, match="power cut"):
        train(cfg)
    add_callback(Seen())
    run_dir = Path(cfg.paths.run_dir)
    assert json.loads((run_dir / "record.json").read_text())["status"] == "failed"

    metrics, theirs = uninterrupted(experiment)
    assert train(cfg) == metrics
    ours = weights(run_dir)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    record = json.loads((run_dir / "record.json").read_text())
    assert (record["status"], record["attempts"]) == ("complete", 2)


@pytest.mark.parametrize(
    ("name", "overrides"), [("mean_offset", ["trainer.limit_val_batches=0"]), ("ridge", [])]
)
def test_a_yardstick_is_fitted_tested_and_kept_with_and_without_validation(
    name, overrides, smoke_config, tmp_path
):
    cfg = smoke_config(tmp_path, f"experiment=detector/{name}", "callbacks.pictures=null", *overrides)
    metrics = train(cfg)
    assert metrics["test/mpjpe"] != metrics["test/initial_mpjpe"]
    if not overrides:
        assert metrics["val/mpjpe"] != metrics["val/initial_mpjpe"]
        path = Path(cfg.paths.run_dir) / "checkpoints" / "best.ckpt"
        state = torch.load(path, weights_only=True)["state_dict"]
        assert state["net.bias"].any()
        assert state["net.gram"][-1, -1] == 32


@pytest.mark.parametrize(
    ("override", "error", "message"),
    [
        ("body.path=missing.npz", FileNotFoundError, "missing.npz"),
        ("data.source.path=missing.npz", FileNotFoundError, "missing.npz"),
        ("data.synthesis.margin_px=300", ValueError, "margin_px"),
    ],
)
def test_bad_input_ends_a_run_before_it_starts(override, error, message, smoke_config, tmp_path):
    with pytest.raises(error, match=message):
        train(smoke_config(tmp_path, "experiment=detector/proposed", override))
    assert not list(tmp_path.glob("runs/*"))


def test_a_checkpoint_is_not_for_training(smoke_config, tmp_path):
    with pytest.raises(ValueError, match="ckpt_path: it is what task=evaluate reads"):
        train(smoke_config(tmp_path, "ckpt_path=some.ckpt"))


def test_a_damaged_checkpoint_to_resume_from_is_named(trained, smoke_config, tmp_path):
    run_dir = shutil.copytree(trained[1], tmp_path / "runs" / trained[1].name)
    (run_dir / "record.json").unlink()
    (run_dir / "checkpoints" / "last.ckpt").write_bytes(b"half a")
    with pytest.raises(ValueError, match=r"last\.ckpt' is damaged"):
        train(smoke_config(tmp_path, "experiment=detector/proposed"))


def test_names_from_a_configuration_lead_to_no_other_directory(smoke_config, tmp_path):
    cfg = smoke_config(tmp_path, "name=../../up", "preset.name='../up'")
    assert set_run_directory(cfg, "runs", "hash") == tmp_path / "runs" / "--..-up---up-hash"


def test_another_content_of_the_pose_file_is_another_run_and_nan_is_none(smoke_config, tmp_path):
    (tmp_path / "split.json").write_text('{"train": ["a"], "val": ["b"], "test": ["c"]}')
    path = tmp_path / "poses.npz"
    cfg = smoke_config(
        tmp_path, f"data.source.path={path}", f"data.source.split_path={tmp_path / 'split.json'}"
    )
    hashes = []
    for value in (0.0, 0.1):
        np.savez(path, poses=np.full((3, 72), value), clip=np.array(["a", "b", "c"]))
        datamodule = build(cfg.data)
        assert "own file poses.npz" in datamodule.licence
        hashes.append(config_hash(identity(cfg, datamodule.fingerprint)))
    assert hashes[0] != hashes[1]
    np.savez(path, poses=np.full((3, 72), np.nan), clip=np.array(["a", "b", "c"]))
    with pytest.raises(ValueError, match="NaN or infinite"):
        train(cfg)


def test_a_nan_loss_stops_a_run_and_says_so(smoke_config, tmp_path):
    diverging = ("module.optimizer.lr=1e30", "trainer.max_epochs=3", "callbacks.pictures=null")
    cfg = smoke_config(tmp_path, "experiment=detector/basic", *diverging)
    with pytest.raises(FloatingPointError, match="lower the learning rate"):
        train(cfg)
    record = json.loads((Path(cfg.paths.run_dir) / "record.json").read_text())
    assert record["status"] == "failed"


def test_a_picture_that_cannot_be_drawn_warns_once_and_stops_nothing(smoke_config, tmp_path, monkeypatch):
    import callbacks.pictures

    def broken(*arguments):
        raise OSError("no ink")

    monkeypatch.setattr(callbacks.pictures, "draw_samples", broken)
    with pytest.warns(UserWarning, match="no pictures: OSError: no ink") as caught:
        train(smoke_config(tmp_path, "experiment=detector/basic"))
    assert len([warning for warning in caught if "no ink" in str(warning.message)]) == 1


def wait_for(condition, exit_code, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert exit_code() is None, "the run ended by itself"
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


def start(directory, *overrides):
    return subprocess.Popen(
        [sys.executable, "run.py", "preset=smoke", "logger=csv", f"paths.output_dir={directory}", *overrides],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # a group, which a signal ends with its workers
    )


@pytest.mark.slow
def test_sigterm_and_ctrl_c_are_said_and_recorded_and_the_run_goes_on(tmp_path):
    overrides = ("experiment=detector/basic", "trainer.max_epochs=400")

    def written():
        return next((path.stat().st_mtime_ns for path in tmp_path.glob("runs/*/checkpoints/last.ckpt")), 0)

    for number, returncode in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        before = written()
        process = start(tmp_path, *overrides, "callbacks.pictures=null", "preset.num_val=1")
        wait_for(lambda before=before: written() > before, process.poll)
        process.send_signal(number)
        output = process.communicate(timeout=60)[0]
        assert process.returncode == returncode
        assert f"ended by {number.name}: a training or a recording is resumed by the same command" in output
        assert "Traceback" not in output
        [record] = tmp_path.glob("runs/*/record.json")
        assert json.loads(record.read_text())["status"] == "interrupted"
        if number == signal.SIGTERM:
            [path] = tmp_path.glob("runs/*/checkpoints/last.ckpt")
            epoch = torch.load(path, weights_only=True)["epoch"]
    assert "resuming from" in output
    assert f"epoch {epoch + 2}/400" in output
    assert f"epoch {epoch}/400" not in output


@pytest.mark.slow
@pytest.mark.parametrize(("experiment", "num_workers"), [("detector/proposed", 1), ("mesh/proposed", 2)])
def test_a_run_killed_at_three_random_moments_equals_an_uninterrupted_one(tmp_path, experiment, num_workers):
    overrides = (f"experiment={experiment}", "trainer.max_epochs=20", f"data.num_workers={num_workers}")
    results = {}
    for name, num_kills in (("killed", 3), ("whole", 0)):
        directory = tmp_path / name
        moments = np.random.default_rng(num_workers).uniform(0, 2.5, num_kills)
        for attempt, moment in enumerate(moments, 1):
            process = start(directory, *overrides)

            def has_begun(directory=directory, attempt=attempt):
                records = [read_json(path) for path in directory.glob("runs/*/record.json")]
                return any(record and record["attempts"] == attempt for record in records)

            wait_for(has_begun, process.poll)
            time.sleep(moment)
            assert process.poll() is None, "it ended before it was killed; train for more epochs"
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate(timeout=60)
        process = start(directory, *overrides)
        output = process.communicate(timeout=300)[0]
        assert process.returncode == 0, output
        [run_dir] = directory.glob("runs/*")
        assert read_json(run_dir / "record.json")["attempts"] == num_kills + 1
        with np.load(run_dir / "test_errors.npz") as errors:
            results[name] = (read_json(run_dir / "metrics.json"), weights(run_dir), dict(errors))
    (metrics, ours, errors), (expected_metrics, theirs, expected_errors) = results.values()
    assert metrics == expected_metrics
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert all(np.array_equal(errors[name], expected_errors[name]) for name in expected_errors)
