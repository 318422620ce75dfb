import json
from pathlib import Path

import pytest
import torch
import yaml

from ljn.runs.checkpoints import read_checkpoint
from ljn.runs.packages import find_package
from ljn.tasks.evaluate import evaluate, evaluate_checkpoint
from ljn.tasks.overrides import with_checkpoint_config


def evaluation(smoke_config, trained, tmp_path, *overrides, ckpt_path=None):
    checkpoint = trained[1] / "checkpoints" / "best.ckpt"
    return smoke_config(tmp_path, "task=evaluate", f"ckpt_path={ckpt_path or checkpoint}", *overrides)


@pytest.mark.slow
def test_several_checkpoints_go_in_one_multirun_and_other_workers_give_exactly_the_metrics_of_training(
    trained, run_py, tmp_path
):
    metrics, run_dir = trained
    other = edited(trained, tmp_path, lambda content: content["state_dict"]["net.head.4.bias"].add_(0.1))
    done = run_py(
        *("-m", "task=evaluate", f"ckpt_path={run_dir / 'checkpoints' / 'best.ckpt'},{other}"),
        *(f"paths.output_dir={tmp_path}", "data.num_workers=2", "logger=csv"),
    )
    assert "2 jobs: 0 runs, 2 evaluations" in done.stdout
    [sweep] = (tmp_path / "sweeps").iterdir()
    evaluated = list((tmp_path / "evaluations").iterdir())
    groups = {yaml.safe_load((directory / "config.yaml").read_text())["group"] for directory in evaluated}
    assert groups == {sweep.name.removesuffix("-smoke").removesuffix("-small")}
    records = [json.loads((directory / "record.json").read_text()) for directory in evaluated]
    assert {(record["trained_by"], record["status"]) for record in records} == {(run_dir.name, "complete")}
    results = [json.loads((directory / "metrics.json").read_text()) for directory in evaluated]
    expected = {name: value for name, value in metrics.items() if name.startswith("test/")}
    assert [result == expected for result in results].count(True) == 1
    assert len(results) == 2


def test_an_evaluation_needs_a_checkpoint(smoke_config, tmp_path):
    with pytest.raises(ValueError, match="ckpt_path: expected the checkpoint to evaluate, got null"):
        evaluate(smoke_config(tmp_path, "task=evaluate"))
    with pytest.raises(FileNotFoundError, match=r"no file 'nowhere\.ckpt'"):
        evaluate(smoke_config(tmp_path, "task=evaluate", "ckpt_path=nowhere.ckpt"))


def edited(trained, tmp_path, edit):
    content = torch.load(trained[1] / "checkpoints" / "best.ckpt", weights_only=True)
    edit(content)
    torch.save(content, tmp_path / "edited.ckpt")
    return tmp_path / "edited.ckpt"


def test_a_checkpoint_of_another_body_is_an_error(trained, smoke_config, tmp_path):
    path = edited(trained, tmp_path, lambda content: content["ljn"].update(body_hash="0123456789abcdef"))
    with pytest.raises(ValueError, match=r"trained with the bodies 0123456789abcdef; .*body\.path"):
        evaluate(evaluation(smoke_config, trained, tmp_path, ckpt_path=path))


def test_overrides_change_data_and_nothing_that_the_checkpoint_decides(trained, smoke_config, tmp_path):
    checkpoint = read_checkpoint(trained[1] / "checkpoints" / "best.ckpt")
    cfg = evaluation(smoke_config, trained, tmp_path)
    typed = ["task=evaluate", "data.synthesis.keypoint_noise_px=15", "logger=csv"]
    merged = with_checkpoint_config(cfg, checkpoint, typed)
    assert merged.data.synthesis.keypoint_noise_px == 15
    assert merged.data.observation.num_points == 128
    for override in (
        *("model.edm=false", "preset=thesis", "experiment=detector/basic", "seed=3"),
        *("data/camera=kinect_v2", "~data.synthesis.distance_m", "+data.more=1", "sweep=demo"),
    ):
        with pytest.raises(ValueError, match="come from the checkpoint"):
            with_checkpoint_config(cfg, checkpoint, [override])
    with pytest.raises(ValueError, match="data=rgb: model, data and sizes come from the checkpoint"):
        with_checkpoint_config(
            evaluation(smoke_config, trained, tmp_path, "data=rgb"), checkpoint, ["data=rgb"]
        )
    with pytest.raises(ValueError, match=r"'data\.source' holds several values"):
        with_checkpoint_config(cfg, checkpoint, ["data.source=null"])
    with pytest.raises(ValueError, match=r"no key 'data\.num_tset'; known there: .*num_test"):
        with_checkpoint_config(cfg, checkpoint, ["data.num_tset=3"])


def test_a_sensor_is_chosen_as_a_whole_and_then_changed(trained, smoke_config, tmp_path):
    checkpoint = read_checkpoint(trained[1] / "checkpoints" / "best.ckpt")
    steps = {"holes": {"_target_": "datamodules.sensor.Holes", "share": 1.0}}
    checkpoint.config["data"]["sensor"] = {"_target_": "datamodules.sensor.Sensor", "steps": steps}
    typed = ["data/sensor=kinect_v2", "data.sensor.strength=0.5"]
    merged = with_checkpoint_config(
        evaluation(smoke_config, trained, tmp_path, *typed[:1]), checkpoint, typed
    )
    assert merged.data.sensor.strength == 0.5
    assert "multipath" in merged.data.sensor.steps
    assert "holes" not in merged.data.sensor.steps
    assert merged.data.synthesis == checkpoint.config["data"]["synthesis"]
    cfg = evaluation(smoke_config, trained, tmp_path)
    assert with_checkpoint_config(cfg, checkpoint, ["data/sensor=gaussian"]).data.sensor is None


def test_a_source_is_chosen_as_a_whole_and_has_the_checkpoints_bodies(trained, smoke_config, tmp_path):
    checkpoint = read_checkpoint(trained[1] / "checkpoints" / "best.ckpt")
    checkpoint.config["body"]["genders"] = ["male"]
    typed = ["data/source=npz", "data.source.path=poses.npz", "data.source.stride=3"]
    merged = with_checkpoint_config(evaluation(smoke_config, trained, tmp_path, *typed), checkpoint, typed)
    assert merged.data.source._target_ == "datamodules.sources.npz.NpzSource"
    assert (merged.data.source.path, merged.data.source.stride) == ("poses.npz", 3)
    assert merged.data.source.genders == ["male"]
    typed = ["data/source=mixed", "data.source.weights.npz=2", "body.genders=[neutral]"]
    merged = with_checkpoint_config(evaluation(smoke_config, trained, tmp_path, *typed), checkpoint, typed)
    assert merged.data.source.weights == {"embedded": 1, "amass": 0, "bvh": 0, "npz": 2, "surreal": 0}
    assert all(source.genders == ["neutral"] for source in merged.data.source.sources.values())


def test_colours_are_changed_with_the_name_of_their_kind_of_data(write_checkpoint, smoke_config, tmp_path):
    checkpoint = read_checkpoint(write_checkpoint("keypoints/cpn"), stage="keypoints")
    typed = ["data=rgb", "data/photo=plain", "data.background.kind=green"]
    merged = with_checkpoint_config(smoke_config(tmp_path, *typed), checkpoint, typed)
    assert merged.data.photo is None
    assert merged.data.background.kind == "green"
    assert merged.data.recipe == checkpoint.config["data"]["recipe"]


def test_an_evaluation_has_this_machines_values_and_the_checkpoints_keys(
    write_checkpoint, smoke_config, tmp_path
):
    checkpoint = read_checkpoint(write_checkpoint("detector/basic", "trainer.accelerator=cpu"))
    del checkpoint.config["data"]["prefetch_batches"]  # a data module without it
    here = ("data.num_workers=3", "trainer.accelerator=gpu", "trainer.max_epochs=7", "name=other")
    merged = with_checkpoint_config(smoke_config(tmp_path, *here), checkpoint, [])
    assert (merged.data.num_workers, merged.trainer.accelerator) == (3, "gpu")
    assert merged.data.cache_dir == f"{tmp_path}/cache"
    assert (merged.trainer.max_epochs, merged.name) == (2, "detector/basic")
    assert "prefetch_batches" not in merged.data


def test_other_bodies_reach_all_that_was_made_of_the_bodies_group(write_checkpoint, smoke_config, tmp_path):
    checkpoint = read_checkpoint(write_checkpoint("mesh/proposed"))
    typed = ["body.path=bodies", "body.genders=[male]", "body.predicted=male"]
    merged = with_checkpoint_config(smoke_config(tmp_path), checkpoint, typed)
    assert (merged.data.body_path, merged.module.body_path) == ("bodies", "bodies")
    assert (merged.data.source.genders, merged.module.genders) == (["male"], ["male"])
    assert merged.module.predicted == "male"


def test_a_mesh_checkpoint_carries_the_detector_that_it_was_trained_on(
    write_checkpoint, smoke_config, tmp_path
):
    detector = tmp_path / "detector.ckpt"
    detector.write_bytes(data := write_checkpoint("detector/basic").read_bytes())
    path = write_checkpoint("mesh/proposed", f"data.detector_ckpt={detector}")
    call = smoke_config(tmp_path)

    def found(*typed):
        return Path(with_checkpoint_config(call, read_checkpoint(path), list(typed)).data.detector_ckpt)

    assert found() == detector
    detector.write_bytes(b"another one")
    assert found().read_bytes() == data
    detector.unlink()
    assert found().read_bytes() == data
    assert found().parent == tmp_path / "cache" / "detectors"
    assert found("data.detector_ckpt=mine.ckpt") == Path("mine.ckpt")
    content = torch.load(path, weights_only=True)
    del content["ljn"]["detector"]  # as older checkpoints are
    torch.save(content, path)
    with pytest.raises(FileNotFoundError, match=r"no file .*detector\.ckpt'.*data\.detector_ckpt=FILE"):
        found()


@pytest.mark.slow
def test_refined_meshes_have_metrics_beside_the_others(smoke_config, tmp_path):
    call = ("task=evaluate", "weights=small", "task.stage=mesh", "data.num_test=8", "data.num_workers=0")
    typed = ["data.num_test=8", "data.num_workers=0", "data.sensor.strength=0"]
    path = find_package("small", "weights")
    cfg = smoke_config(tmp_path, *call, "refine=true")
    metrics = evaluate_checkpoint(cfg, path, typed, stage="mesh")
    assert metrics["test/refined_apve_camera"] < 0.8 * metrics["test/apve_camera"]
    assert metrics["test/refined_mpjpe_camera"] < metrics["test/mpjpe_camera"]
    record = json.loads((tmp_path / cfg.paths.run_dir / "record.json").read_text())
    assert record["refine"] == "accurate"
    assert record["metrics"]["refined_harmed"]["unit"] == "%"
    plain = smoke_config(tmp_path, *call)
    raw = evaluate_checkpoint(plain, path, typed, stage="mesh")
    assert plain.paths.run_dir != cfg.paths.run_dir
    assert raw == {name: value for name, value in metrics.items() if "refined" not in name}


def test_joints_alone_are_not_refined(smoke_config, tmp_path):
    cfg = smoke_config(tmp_path, "task=evaluate", "weights=small", "refine=fast", "data.num_workers=0")
    with pytest.raises(ValueError, match=r"refine: 'fast' fits meshes, and .* is no mesh regressor"):
        evaluate(cfg)
    cfg.refine = "slow"
    with pytest.raises(ValueError, match="refine: expected true, false, accurate or fast, got 'slow'"):
        evaluate(cfg)
