import csv
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from datamodules.bench import BenchSamples
from ljn.benchmark.labels import joint_map
from ljn.tasks.benchmark import benchmark

SMALL = ("task=benchmark", "bench.num_samples=8", "bench.num_axis=4")
DOCS = Path(__file__).parents[2] / "docs" / "benchmark.md"
BROKEN = """


class Broken(CloudMean):
    name = "broken"

    def __call__(self, frames):
        return super().__call__(frames) * np.nan
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A place where the eight samples are rendered once."""
    return f"paths.cache_dir={tmp_path_factory.mktemp('cache')}"


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """A user's own module, `foreign_predictors`: the example of the docs, and one that is broken."""
    [example] = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    (tmp_path / "foreign_predictors.py").write_text(example + BROKEN)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("foreign_predictors", None)


def results(tmp_path):
    [path] = (tmp_path / "benchmarks").glob("*/results.csv")
    with path.open() as file:
        return path.parent, list(csv.DictReader(file))


def test_the_weights_that_ship_are_measured_beside_the_baseline(smoke_config, tmp_path, cache, capsys):
    metrics = benchmark(smoke_config(tmp_path, *SMALL, cache))
    directory, rows = results(tmp_path)
    assert directory.name.startswith("ljn-bench-1-")
    assert {path.name for path in directory.iterdir()} == {
        "results.csv",
        "samples.csv",
        "index.html",
        "table.md",
    }
    assert {row["predictor"] for row in rows} == {"small", "lifted keypoints"}
    [row] = [
        row for row in rows if (row["predictor"], row["axis"], row["keypoints"]) == ("small", "base", "given")
    ]
    assert 0 < float(row["mpjpe_mean"]) < 60
    assert 0 < float(row["pve_mean"]) < 60
    assert metrics["benchmark/small (10 px keypoints)"] == pytest.approx(float(row["mpjpe_mean"]), abs=1e-3)
    [joints] = [
        row for row in rows if row["axis"] == "joint_noise" and row["value"] == "0" and row["pve_mean"]
    ]
    assert float(joints["pve_mean"]) < float(row["pve_mean"])
    printed = capsys.readouterr().out
    assert "Base condition" in printed
    assert BenchSamples(cache.partition("=")[2], num_samples=8).depth_hash in printed


def test_checkpoints_are_called_after_their_runs_and_read_points_where_they_take_them(
    smoke_config, tmp_path, cache, write_checkpoint
):
    cascade = write_checkpoint("detector/cascade", "model.patch_sizes_m=[0.5]")
    proposed = write_checkpoint("detector/proposed")
    listed = f"task.checkpoints=[{cascade},{proposed}]"
    benchmark(smoke_config(tmp_path, *SMALL, cache, listed, "predictor=[]", "bench.axes=[points,missing]"))
    _, rows = results(tmp_path)
    assert {row["predictor"] for row in rows} == {"detector/cascade", "detector/proposed"}
    statuses = {
        (row["predictor"], row["axis"], row["keypoints"], row["value"]): row["status"] for row in rows
    }
    assert statuses["detector/cascade", "points", "given", "256"] == "not read"
    assert statuses["detector/proposed", "points", "given", "256"] == ""
    assert statuses["detector/proposed", "points", "none", "256"] == "needs keypoints"
    assert statuses["detector/proposed", "missing", "given", "75"] == ""
    assert statuses["detector/proposed", "missing", "given", "100"] == "needs keypoints"
    assert statuses["detector/cascade", "missing", "given", "100"] == ""
    points = {
        row["value"]: row["mpjpe_mean"] for row in rows if row["axis"] == "points" and row["mpjpe_mean"]
    }
    assert len(set(points.values())) == 6


def test_a_foreign_predictor_comes_in_by_its_import_path(smoke_config, tmp_path, cache, foreign):
    typed = "task.predictors={mine:{_target_:foreign_predictors.CloudMean,height_m:0.1}}"
    benchmark(smoke_config(tmp_path, *SMALL, cache, typed, "predictor=[]"))
    _, rows = results(tmp_path)
    assert {row["predictor"] for row in rows} == {"mine"}
    [row] = [row for row in rows if row["axis"] == "base" and row["keypoints"] == "none"]
    assert 100 < float(row["mpjpe_mean"]) < 800


def test_one_that_is_broken_is_named_and_the_others_are_written(smoke_config, tmp_path, cache, foreign):
    both = "{mine:{_target_:foreign_predictors.CloudMean},other:{_target_:foreign_predictors.Broken}}"
    with pytest.raises(
        ValueError, match=r"1 conditions failed.*predictor 'broken', sample 0: joints: 72 values"
    ):
        benchmark(smoke_config(tmp_path, *SMALL, cache, f"task.predictors={both}", "predictor=[]"))
    _, rows = results(tmp_path)
    assert {
        row["predictor"]: row["status"]
        for row in rows
        if row["axis"] == "base" and row["keypoints"] == "none"
    } == {
        "mine": "",
        "broken": "FAILED",
    }


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["bench=frames"], r"bench\.path: expected a file of real frames, got null"),
        (["task.predictors={a:3}"], r"task\.predictors\.a: expected a mapping with a _target_.*got 3"),
        (["task.predictors={a:{_target_:nowhere.Nothing}}"], r"task\.predictors\.a: .*nowhere"),
        (
            ["task.mesh_ckpt_path=a.ckpt"],
            r"task\.mesh_ckpt_path: expected the joint detector's checkpoint beside it",
        ),
        (["task.checkpoints=[small,small]"], r"two are called 'small'; give one another name=NAME"),
        (["bench.num_axis=0"], r"bench\.num_axis: expected a whole number of 1 or more, got 0"),
        (["bench.num_samples=2001"], r"has 2000 samples, got 2001"),
        (["~bench"], r"bench: expected a benchmark, got null; add bench=ljn_bench"),
    ],
)
def test_what_is_wrong_with_a_call_is_said(overrides, message, smoke_config, tmp_path, cache):
    with pytest.raises(ValueError, match=message):
        benchmark(smoke_config(tmp_path, "task=benchmark", cache, *overrides))


def test_real_frames_with_the_preset_of_their_names(smoke_config, tmp_path, cache):
    samples = BenchSamples(cache.partition("=")[2], num_samples=8)
    cfg = smoke_config(tmp_path, "task=benchmark", "bench=itop", cache, "bench.num_samples=8")
    names, camera = list(cfg.bench.joints), samples.camera(0)
    joints = joint_map(names, dict(cfg.bench.joints))(samples.truth([0, 0]).joints)
    path = tmp_path / "frames.npz"
    depth = np.stack([samples.clean_depth(0)] * 2)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    np.savez(path, depth_m=depth, mask=depth > 0, K=intrinsics, joints=joints, names=np.array(names))
    cfg.bench.path = str(path)
    benchmark(cfg)
    directory, rows = results(tmp_path)
    assert directory.name.startswith("frames-")
    wanted = {"labels": "all", "offset": "none", "joint": "all"}
    means = {
        row["method"]: row["mean"] for row in rows if all(row[key] == value for key, value in wanted.items())
    }
    assert 0 < float(means["small, no keypoints"]) < 100
    assert 0 < float(means["small, keypoints of the labels"]) < 100
    [fixed] = [
        row
        for row in rows
        if row["offset"] == "fixed"
        and row["method"] == "small, no keypoints"
        and row["joint"] == "head"
        and row["labels"] == "all"
    ]
    assert float(fixed["mean"]) > 0
