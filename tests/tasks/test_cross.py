import json

import pytest

from ljn.tasks.cross import cross


def test_a_run_is_trained_once_and_tested_on_other_data(smoke_config, tmp_path):
    metrics = {}
    for noise_px in (0, 15):
        cfg = smoke_config(tmp_path, f"experiment=detector/cross_{noise_px}px")
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


def test_a_row_is_configured_as_the_experiment_that_it_trains(run_py, tmp_path):
    done = run_py(
        *("experiment=mesh/chain", "task.trains=mesh/basic", "preset=smoke", f"paths.output_dir={tmp_path}"),
        check=False,
    )
    assert done.returncode == 1
    assert "task.trains: 'mesh/basic' has another model than this row" in done.stderr
    assert not (tmp_path / "runs").exists()


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
