"""What W&B and TensorBoard are told, read back from the files of offline runs."""

import json
import struct
import time
from pathlib import Path

import pytest
import wandb
from lightning.pytorch.loggers import WandbLogger
from omegaconf import OmegaConf

import ljn.tasks.tracking as tracking_module
from ljn.tasks.evaluate import evaluate
from ljn.tasks.tracking import log_table, summaries
from ljn.tasks.train import train

BLOCK, HEADER, FILE_HEADER = 32768, 7, 7


def read_records(path):
    """The records of an offline W&B run's file: protocol buffers in LevelDB's log format."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, position, parts, records = path.read_bytes(), FILE_HEADER, [], []
    while position + HEADER <= len(data):
        if BLOCK - position % BLOCK < HEADER:  # a header never spans blocks
            position += BLOCK - position % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", data[position : position + HEADER])
        parts.append(data[position + HEADER : position + HEADER + length])
        position += HEADER + length
        if kind in (1, 4):  # whole, or the last part
            records.append(Record.FromString(b"".join(parts)))
            parts = []
    return records


def records_of(directory):
    """The records of the finished offline W&B runs below a directory, a list for each run."""
    runs = []
    for path in sorted(Path(directory).rglob("run-*.wandb")):
        end = time.monotonic() + 30
        # W&B's own process may still be writing when a run has been told to finish.
        while not any(record.HasField("exit") for record in read_records(path)):
            assert time.monotonic() < end, f"{path} has no end"
            time.sleep(0.1)
        runs.append(read_records(path))
    return runs


def described(records):
    """A run's description, its config and, by name, what the summaries of its metrics keep."""
    [run] = [record.run for record in records if record.HasField("run")][:1]
    config = {}
    for record in records:
        for update in (*record.run.config.update, *record.config.update):
            config[update.key or update.nested_key[0]] = json.loads(update.value_json)
    kept = {}
    for record in records:
        if record.HasField("metric"):
            summary = record.metric.summary
            kept[record.metric.name] = {field.name for field, value in summary.ListFields() if value}
    return run, config, kept


def media(records):
    """The paths of the files that a run's history and files name."""
    return {entry.path for record in records if record.HasField("files") for entry in record.files.files}


@pytest.fixture(scope="module")
def tracked(smoke_config, tmp_path_factory):
    """A run and its evaluation in one process, tracked by W&B offline."""
    directory, sweep = tmp_path_factory.mktemp("tracked"), ("logger=default", "group=table")
    run = smoke_config(directory, "experiment=detector/basic", "tags=[a]", *sweep)
    train(run)
    checkpoint = Path(run.paths.run_dir) / "checkpoints" / "best.ckpt"
    evaluation = smoke_config(directory, "task=evaluate", f"ckpt_path={checkpoint}", *sweep)
    evaluate(evaluation)
    return [Path(cfg.paths.run_dir) for cfg in (run, evaluation)]


@pytest.mark.slow
def test_each_job_of_a_sweep_is_a_wandb_run_of_its_group(tracked):
    seen = []
    for run_dir, job_type in zip(tracked, ("train", "evaluate")):
        [records] = records_of(run_dir / "wandb")
        run, config, _ = described(records)
        assert (run.project, run.run_group, run.display_name) == ("ljn", "table", "detector/basic")
        assert run.job_type == job_type
        assert run.run_id == run_dir.name.rpartition("-")[2]
        assert config["preset"]["name"] == "smoke"
        [end] = [record.exit for record in records if record.HasField("exit")]
        assert end.exit_code == 0
        seen.append(run.run_id)
    assert len(set(seen)) == 2


@pytest.mark.slow
def test_an_evaluation_names_its_training_run(tracked):
    [records] = records_of(tracked[1] / "wandb")
    run, config, _ = described(records)
    assert config["trained_by"] == tracked[0].name
    [training] = records_of(tracked[0] / "wandb")
    assert config["trained_by_id"] == described(training)[0].run_id
    assert tracked[0].name in run.notes


def test_a_summary_keeps_the_best_validation(tracked):
    [records] = records_of(tracked[0] / "wandb")
    kept = described(records)[2]
    assert kept["val/mpjpe"] == {"min"}
    assert kept["val/pckh"] == {"max"}
    assert kept["val/pckh_threshold_mm"] == {"last"}
    assert "test/mpjpe" not in kept


def test_a_mesh_regressors_summary_keeps_the_least_errors(compose_config):
    cfg = compose_config("experiment=mesh/proposed", "paths.run_dir=x")
    kept = summaries(OmegaConf.to_container(cfg, resolve=True))
    assert (kept["val/apve"], kept["val/mpjpe"], kept["train/loss"]) == ("min", "min", "min")


def test_pictures_go_to_wandb(tracked):
    [records] = records_of(tracked[0] / "wandb")
    paths = media(records)
    for key in ("val/samples", "test/extremes"):
        assert any(path.startswith(f"media/images/{key}") for path in paths), paths


def test_a_sweeps_table_is_a_run_of_its_group(tmp_path, compose_config):
    logger = compose_config("group=table", f"paths.run_dir={tmp_path}").logger
    rows = [{"row": "basic", "mpjpe": 32.1}, {"row": "proposed", "mpjpe": 24.2, "seeds": [0, 1]}]
    log_table("table_3_2", rows, logger, tmp_path / "sweep")
    [records] = records_of(tmp_path / "sweep")
    run, _, _ = described(records)
    assert (run.project, run.run_group, run.job_type) == ("ljn", "table", "report")
    assert run.display_name == "table_3_2"
    [path] = (tmp_path / "sweep").rglob("*.table.json")
    table = json.loads(path.read_text())
    assert table["columns"] == ["row", "mpjpe", "seeds"]
    assert table["data"] == [["basic", 32.1, None], ["proposed", 24.2, "[0, 1]"]]
    log_table("table_3_2", rows[:1], logger, tmp_path / "again")
    assert described(records_of(tmp_path / "again")[0])[0].run_id == run.run_id


def test_without_wandb_no_table_is_logged(tmp_path):
    log_table("table", [{"a": 1}], {"csv": {}}, tmp_path / "sweep")
    log_table("table", [{"a": 1}], None, tmp_path / "sweep")
    assert not (tmp_path / "sweep").exists()


def test_tensorboard_follows_a_run(smoke_config, tmp_path):
    events = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator",
        reason="TensorBoard is not installed: pip install -e '.[tensorboard]'",
    )
    cfg = smoke_config(tmp_path, "experiment=detector/basic", "logger=tensorboard", "callbacks.pictures=null")
    metrics = train(cfg)
    [directory] = (Path(cfg.paths.run_dir) / "tensorboard").iterdir()
    read = events.EventAccumulator(str(directory)).Reload()
    assert len(read.Scalars("train/loss")) == 2
    assert read.Scalars("test/mpjpe")[0].value == pytest.approx(metrics["test/mpjpe"])


def test_a_run_is_kept_offline_where_the_server_cannot_be_reached(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # where nobody listens
    monkeypatch.setenv("WANDB_API_KEY", 40 * "a")
    monkeypatch.setattr(tracking_module, "_PATIENCE_S", 1.0)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    wandb.teardown()  # what it has read of the environment before
    logger = WandbLogger(save_dir=tmp_path, project="ljn", offline=False)
    try:
        tracking_module._start(logger)
        logger.log_metrics({"train/loss": 1.0})
    finally:
        wandb.finish()
        wandb.teardown()
    assert "kept offline; `wandb sync` uploads" in caplog.text
    assert list(tmp_path.glob("wandb/offline-run-*"))
