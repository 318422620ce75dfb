import json
from pathlib import Path

import pytest
import torch
from hydra import initialize_config_dir

from ljn.tasks.cross import cross
from ljn.tasks.train import composed, train

CONF = Path(__file__).parents[2] / "conf"


@pytest.mark.slow
def test_a_run_is_trained_once_and_tested_on_other_data(smoke_config, tmp_path):
    metrics = {}
    for noise_px in (0, 15):
        cfg = smoke_config(tmp_path, f"experiment=detector/cross_{noise_px}px", "callbacks.pictures=null")
        metrics[noise_px] = cross(cfg)
    assert metrics[0]["test/initial_mpjpe"] < metrics[15]["test/initial_mpjpe"]
    [run] = (tmp_path / "runs").iterdir()
    assert run.name.startswith("detector-proposed-smoke-")
    records = [json.loads(path.read_text()) for path in (tmp_path / "evaluations").glob("*/record.json")]
    assert {record["name"] for record in records} == {"detector/cross_0px", "detector/cross_15px"}
    assert {record["trained_by"] for record in records} == {run.name}

    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/metrics.json")}
    cfg = smoke_config(tmp_path, "experiment=detector/cross_15px")
    assert cross(cfg) == metrics[15]
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/metrics.json")} == before
    assert cfg.paths.run_dir.startswith(str(tmp_path / "evaluations" / "detector-cross_15px-smoke-"))


def test_it_has_to_be_said_what_is_trained(smoke_config, tmp_path):
    with pytest.raises(ValueError, match=r"task\.trains: expected the experiment"):
        cross(smoke_config(tmp_path, "task=cross"))


def test_a_row_is_configured_as_the_experiment_that_it_trains(smoke_config, monkeypatch, tmp_path):
    typed = ["experiment=mesh/chain", "task.trains=mesh/basic"]
    cfg = smoke_config(tmp_path, *typed)
    monkeypatch.setattr("ljn.tasks.cross.typed_overrides", lambda: [*typed, "preset=smoke"])
    with (
        initialize_config_dir(str(CONF), version_base="1.3"),
        pytest.raises(ValueError, match=r"task\.trains: 'mesh/basic' has another model than this row"),
    ):
        cross(cfg)
    assert not (tmp_path / "runs").exists()


def test_the_detector_of_a_chain_has_the_calls_sizes_and_machine_and_nothing_of_the_other_stage(
    compose_config, monkeypatch
):
    typed = (
        "experiment=mesh/chain", "name=x", "seed=3", "debug=overfit", "body.genders=[male]", "tags=[a]",
        "data.observation.num_points=64", "data.num_workers=0", "trainer.precision=64", "paths.output_dir='a=b'",
        "model.num_iterations=1", "task.overrides=[]", "data.synthesis.initial_joints=noised",
        "data.synthesis.joint_noise_m=0.5", "optimized_metric=val/apve", "callbacks.best.mode=max",
        "callbacks.pictures=null", "num_threads=1",
    )  # fmt: skip
    monkeypatch.setattr("ljn.tasks.train.typed_overrides", lambda: list(typed))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = composed("detector/proposed")
    assert (cfg.seed, cfg.data.num_train, cfg.body.genders, cfg.tags) == (3, 8, ["male"], ["a"])
    assert (cfg.data.observation.num_points, cfg.data.num_workers, cfg.trainer.precision) == (64, 0, 64)
    assert (cfg.paths.output_dir, cfg.callbacks.pictures, cfg.num_threads) == ("a=b", None, 1)
    assert (cfg.data.synthesis.initial_joints, cfg.data.synthesis.joint_noise_m) == ("lifted", 0.02)
    assert (cfg.optimized_metric, cfg.callbacks.best.mode) == ("val/mpjpe", "min")
    assert cfg.task._target_ == "ljn.tasks.train.train"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("data.keypoint_noise=5", "has no key 'data.keypoint_noise'"),
        ("model.edm=false", "come from the checkpoint"),
        ("data.synthesis.keypoint_noise_px=-1", "keypoint_noise_px: expected a number of 0 or more"),
    ],
)
def test_a_mistake_in_the_changes_is_an_error_before_the_training(smoke_config, tmp_path, override, message):
    cfg = smoke_config(tmp_path, "experiment=detector/cross_0px", f"task.overrides=['{override}']")
    with pytest.raises(ValueError, match=message):
        cross(cfg)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_the_detector_of_a_chain_is_for_its_test_alone(smoke_config, monkeypatch, tmp_path):
    shared = ["preset=smoke", "logger=csv", "callbacks.pictures=null", f"paths.output_dir={tmp_path}"]
    shared += ["data.num_workers=0", "preset.num_train=8", "preset.num_test=8", "preset.num_val=8"]
    cfg = smoke_config(tmp_path, "experiment=mesh/cascade_chain", *shared)
    for module in ("train", "cross"):
        monkeypatch.setattr(
            f"ljn.tasks.{module}.typed_overrides", lambda: ["experiment=mesh/cascade_chain", *shared]
        )
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cross(cfg)
    [trained] = (tmp_path / "runs").glob("mesh-kinematic-*")
    [tested] = (tmp_path / "evaluations").iterdir()
    detectors = [
        json.loads((directory / "record.json").read_text())["data"]["detector"]
        for directory in (trained, tested)
    ]
    assert detectors[0] is None
    assert detectors[1]["path"].startswith(str(tmp_path / "runs" / "detector-cascade-"))


@pytest.mark.slow
def test_a_training_begins_with_another_s_weights_and_takes_a_detector_s_joints(
    smoke_config, monkeypatch, tmp_path
):
    shared = ["preset=smoke", "logger=csv", "callbacks.pictures=null", f"paths.output_dir={tmp_path}"]
    shared += ["data.num_workers=0", "preset.num_train=8", "preset.num_test=8", "preset.num_val=8"]
    experiment = "experiment=mesh/kinematic_on_cascade"
    # So slow that nothing is learned.
    cfg = smoke_config(tmp_path, experiment, *shared, "preset.max_epochs=1", "module.optimizer.lr=1e-12")
    monkeypatch.setattr("ljn.tasks.train.typed_overrides", lambda: [experiment, *shared])
    with initialize_config_dir(str(CONF), version_base="1.3"):
        train(cfg)
    runs = {path.name.rpartition("-smoke-")[0]: path for path in (tmp_path / "runs").iterdir()}
    assert set(runs) == {"detector-cascade", "mesh-kinematic", "mesh-kinematic_on_cascade"}
    record = json.loads((runs["mesh-kinematic_on_cascade"] / "record.json").read_text())
    first, second = (
        torch.load(runs[name] / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"]
        for name in ("mesh-kinematic", "mesh-kinematic_on_cascade")
    )
    torch.testing.assert_close(first, second, atol=1e-6, rtol=0)
    assert record["begins_with"]["path"] == str(runs["mesh-kinematic"] / "checkpoints" / "best.ckpt")
    assert record["data"]["detector"]["path"] == str(runs["detector-cascade"] / "checkpoints" / "best.ckpt")
