import json

import numpy as np
import pytest

from ljn.tasks.figures import figures

EMPTY_PAGE = 20_000
"""Bytes; a page with drawings is larger."""


@pytest.fixture
def config(smoke_config, tmp_path):
    """The configuration of a call with lists of checkpoints."""

    def make(*overrides, **checkpoints):
        lists = [f"task.{key}=[{','.join(map(str, paths))}]" for key, paths in checkpoints.items()]
        return smoke_config(tmp_path, "task=figures", "task.num_samples=2", *lists, *overrides)

    return make


def read_page(directory, page):
    assert (directory / "figures" / f"{page}.png").stat().st_size > EMPTY_PAGE
    return json.loads((directory / "figures" / "figures.json").read_text())[page]


def test_joints_have_the_errors_of_the_runs_own_test(config, trained, tmp_path):
    metrics = figures(config(detectors=[trained[1] / "checkpoints" / "best.ckpt"]))
    column = read_page(tmp_path, "joints")[0]
    tested = np.load(trained[1] / "test_errors.npz")
    rows = np.searchsorted(tested["sample_id"], column["samples"])
    np.testing.assert_allclose(column["errors_mm"], tested["mpjpe"][rows], rtol=1e-4)
    assert metrics == {"figures/joints_0": pytest.approx(np.mean(column["errors_mm"]))}


def test_noise_is_given_to_each_detector(config, checkpoints, write_checkpoint, tmp_path):
    detectors = [checkpoints[0], checkpoints[0], write_checkpoint("detector/simple_baseline")]
    metrics = figures(config("task.keypoint_noise_px=[5,0,0]", detectors=detectors))
    page = read_page(tmp_path, "joints")
    assert [column["title"].split(", ")[1] for column in page] == ["5 px", "0 px", "0 px"]
    assert len({tuple(column["samples"]) for column in page}) == 1
    assert metrics["figures/joints_0"] != metrics["figures/joints_1"]


def test_meshes_are_drawn_of_the_data_that_are_typed(
    config, checkpoints, write_checkpoint, tmp_path, monkeypatch
):
    typed = ["task=figures", "data.synthesis.joint_noise_m=0.05"]
    monkeypatch.setattr("ljn.tasks.figures.typed_overrides", lambda: typed)
    metrics = figures(config(regressors=[checkpoints[1], write_checkpoint("mesh/basic")]))
    page = read_page(tmp_path, "meshes")
    assert [column["title"] for column in page] == ["mesh/proposed, 0.05 m", "mesh/basic, 0.05 m"]
    assert metrics["figures/meshes_1"] == pytest.approx(np.mean(page[1]["errors_mm"]))


def test_wrong_calls_say_what_is_expected(config, checkpoints, write_checkpoint):
    detector, regressor = checkpoints
    with pytest.raises(ValueError, match="expected checkpoints, got none"):
        figures(config())
    with pytest.raises(ValueError, match="one value for each of the 1 detectors"):
        figures(config("task.keypoint_noise_px=[5,0]", detectors=[detector]))
    with pytest.raises(ValueError, match=r"task\.regressors: expected the checkpoint of a MeshRegressor"):
        figures(config(regressors=[detector]))
    with pytest.raises(ValueError, match="ask for fewer"):
        figures(config("task.num_samples=1000", regressors=[regressor]))
    with pytest.raises(FileNotFoundError, match="no file 'missing"):
        figures(config(detectors=["missing.ckpt"]))
    other = write_checkpoint("detector/proposed", "data.eval_seed=5")
    with pytest.raises(ValueError, match=r"test sets of .* differ"):
        figures(config(detectors=[detector, other]))
