import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from ljn import Pipeline
from ljn.body import load_body_model
from ljn.body.files import _DATA_DIR
from ljn.body.skeleton import PARENTS
from ljn.runs import packages
from ljn.runs.checkpoints import read_checkpoint
from ljn.runs.keys import CONFIG_GROUPS
from ljn.runs.packages import read_about
from ljn.tasks.evaluate import evaluate
from ljn.tasks.figures import figures
from ljn.tasks.package import package
from ljn.tasks.predict import predict
from ljn.tasks.train import train

ROOT = Path(__file__).parents[2]


def said(path):
    return read_about(path.read_bytes(), str(path))


@pytest.fixture(scope="session")
def models(write_checkpoint):
    """Untrained checkpoints that need no keypoints: a joint detector's and a mesh regressor's."""
    detector = write_checkpoint("detector/cascade", "model.patch_sizes_m=[0.5]")
    return detector, write_checkpoint("mesh/kinematic", "model.channels=32", f"data.detector_ckpt={detector}")


@pytest.fixture(scope="session")
def both(models, smoke_config, tmp_path_factory):
    """A package of both, in a folder with its index."""
    directory = tmp_path_factory.mktemp("weights")
    keys = {"ckpt_path": models[0], "task.mesh_ckpt_path": models[1], "task.directory": directory}
    given = [f"{key}={value}" for key, value in keys.items()]
    cfg = smoke_config(directory, "task=package", *given, "task.name=small", "task.licence=CC0-1.0")
    metrics = package(cfg)
    path = directory / "small.safetensors"
    assert metrics["package/megabytes"] == pytest.approx(path.stat().st_size / 1e6)
    assert 0 < metrics["package/detector_rounding"] < 1
    return path


@pytest.fixture
def shipped(both, monkeypatch):
    """The same as the one that ships."""
    monkeypatch.setattr(packages, "SHIPPED", both.parent)
    return both


@pytest.fixture
def image(kinect, tmp_path):
    """A depth image with a camera: something upright, 2 m away."""
    depth = np.zeros((kinect.height, kinect.width), np.float32)
    depth[100:400, 180:240] = 2 + 0.1 * np.sin(np.arange(60) / 9)
    np.save(tmp_path / "depth.npy", depth)
    (tmp_path / "camera.json").write_text(json.dumps(vars(kinect)))
    return depth, [f"task.input={tmp_path / 'depth.npy'}", f"task.camera={tmp_path / 'camera.json'}"]


def test_a_pipeline_of_a_package_predicts_as_that_of_its_checkpoints(models, shipped, image, kinect):
    expected = Pipeline.load(*models)(image[0], kinect)
    pipeline = Pipeline.from_pretrained()
    got = pipeline(image[0], kinect)
    np.testing.assert_allclose(got.joints, expected.joints, atol=0.01)
    np.testing.assert_allclose(got.vertices, expected.vertices, atol=0.02)
    assert not np.array_equal(got.joints, expected.joints)  # int8
    assert pipeline.detector.origin["path"] == str(shipped)


def test_a_package_names_no_place_on_the_machine(models, both):
    about = said(both)
    assert (about["name"], about["licence"], set(about["stages"])) == (
        "small",
        "CC0-1.0",
        {"detector", "mesh"},
    )
    text = json.dumps(about)
    assert str(both.parent.parent) not in text
    assert str(ROOT) not in text
    assert about["stages"]["mesh"]["config"]["data"]["detector_ckpt"] is None
    assert set(about["stages"]["mesh"]["config"]) == set(CONFIG_GROUPS)
    assert read_checkpoint(both, stage="mesh").config["data"]["detector_ckpt"] == str(both)


def test_a_run_s_record_goes_into_its_package(trained, smoke_config, tmp_path):
    metrics, run_dir = trained
    record = json.loads((run_dir / "record.json").read_text())
    assert record["overrides"] == []  # Hydra did not start it
    run = shutil.copytree(run_dir, tmp_path / "runs" / run_dir.name)
    record["overrides"] = [
        "experiment=detector/proposed",
        "paths.output_dir=/home/me",
        "num_threads=1",
        "body.path=/b",
    ]
    (run / "record.json").write_text(json.dumps(record))
    call = ["task=package", f"ckpt_path={run / 'checkpoints' / 'best.ckpt'}", "task.licence=CC0-1.0"]
    package(smoke_config(tmp_path, *call, "task.name=mine", "task.precision=half"))
    training = said(tmp_path / "packages" / "mine.safetensors")["stages"]["detector"]["training"]
    assert training["command"] == "python run.py experiment=detector/proposed"
    assert (training["run"], training["epochs"], training["commit"]) == (run_dir.name, 2, record["commit"])
    assert training["metrics"] == pytest.approx(metrics)
    # Half precision changes a test by little.
    path = tmp_path / "packages" / "mine.safetensors"
    tested = evaluate(smoke_config(tmp_path, "task=evaluate", f"weights={path}"))
    assert tested["test/mpjpe"] == pytest.approx(metrics["test/mpjpe"], rel=1e-2)


@pytest.mark.slow
def test_a_package_s_mesh_is_tested_on_its_detectors_joints(shipped, smoke_config, tmp_path, monkeypatch):
    call = ("task=evaluate", "weights=small")
    assert "test/mpjpe" in evaluate(smoke_config(tmp_path, *call))
    metrics = evaluate(smoke_config(tmp_path, *call, "task.stage=mesh"))
    records = [json.loads(path.read_text()) for path in (tmp_path / "evaluations").glob("mesh*/record.json")]
    assert [record["data"]["detector"]["path"] for record in records] == [str(shipped)]
    monkeypatch.setattr("ljn.tasks.evaluate.typed_overrides", lambda: ["data.detector_ckpt=null"])
    assert evaluate(smoke_config(tmp_path, *call, "task.stage=mesh"))["test/apve"] != metrics["test/apve"]


def test_figures_draw_both_stages(shipped, smoke_config, tmp_path):
    metrics = figures(smoke_config(tmp_path, "task=figures", "task.num_samples=2", "weights=small"))
    assert set(metrics) == {"figures/joints_0", "figures/meshes_0"}


def test_the_weights_that_ship_are_the_default(shipped, image, smoke_config, tmp_path, monkeypatch):
    call = ("task=predict", *image[1])
    assert predict(smoke_config(tmp_path, *call))["predict/frames"] == 1
    assert len(list(tmp_path.glob("predictions/depth-*/depth.glb"))) == 1
    with pytest.raises(
        ValueError, match=r"weights, ckpt_path: expected one of them, got both; weights=small"
    ):
        predict(smoke_config(tmp_path, *call, "weights=small", "ckpt_path=x.ckpt"))
    with pytest.raises(ValueError, match=r"ckpt_path: expected a path, got null"):
        predict(smoke_config(tmp_path, *call, "task.mesh_ckpt_path=x.ckpt"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "index.json").write_text("{}")
    monkeypatch.setattr(packages, "SHIPPED", tmp_path / "empty")
    with pytest.raises(ValueError, match=r"ckpt_path: expected a path, got null"):
        predict(smoke_config(tmp_path, *call))
    with pytest.raises(ValueError, match=r"weights: expected the name of weights .*\(it has none\)"):
        predict(smoke_config(tmp_path, *call, "weights=small"))


def test_weights_are_not_for_training(smoke_config, tmp_path):
    with pytest.raises(ValueError, match="weights: it is what task=evaluate reads"):
        train(smoke_config(tmp_path, "weights=small"))
    with pytest.raises(
        ValueError, match="refine: 'fast' fits meshes of task=predict, evaluate and demo, not of a"
    ):
        train(smoke_config(tmp_path, "refine=fast"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("ckpt_path=null", "ckpt_path: expected text, got None; python run.py task=package"),
        ("task.name=null", "task.name: expected text"),
        ("task.name=../x", r"task\.name: expected letters, digits"),
        ("task.licence=null", "task.licence: expected text"),
        ("task.precision=int4", "task.precision: expected one of int8, half, got 'int4'"),
    ],
)
def test_what_a_package_needs_is_named(change, message, smoke_config, tmp_path):
    given = ("ckpt_path=x.ckpt", "task.name=x", "task.licence=CC0-1.0")
    with pytest.raises(ValueError, match=message):
        package(smoke_config(tmp_path, "task=package", *given, change))


def test_the_body_of_licensed_weights_is_given(write_checkpoint, models, image, kinect, tmp_path):
    for gender in ("female", "male"):
        shutil.copy(_DATA_DIR / f"{gender}.npz", tmp_path)
    changed = load_body_model()
    arrays = {name: getattr(changed, name) for name in ("shapedirs", "posedirs", "J_regressor", "weights")}
    table = np.array([[2**32 - 1, *PARENTS[1:]], range(24)])
    body = tmp_path / "neutral.npz"
    np.savez(body, **arrays, v_template=1.01 * changed.v_template, f=changed.faces, kintree_table=table)
    mesh = write_checkpoint("mesh/kinematic", "model.channels=16", f"body.path={tmp_path}")
    elsewhere = body.rename(tmp_path / "SMPL_OF_MINE.npz")
    with pytest.raises(
        FileNotFoundError, match=r"mesh_ckpt: .*no body of gender neutral.*in Python body_path=FILE"
    ):
        Pipeline.load(models[0], mesh)
    prediction = Pipeline.load(models[0], mesh, body_path=elsewhere)(image[0], kinect)
    assert prediction.vertices.shape == (6890, 3)
    with pytest.raises(ValueError, match=r"the body found here is .*; give the training's body file"):
        Pipeline.load(models[0], mesh, body_path=_DATA_DIR / "neutral.npz")


_ELSEWHERE = """
import sys
import numpy as np
import ljn
from ljn import Camera, Pipeline
assert ljn.__file__.startswith(sys.argv[1]), ljn.__file__
depth = np.zeros((512, 424), np.float32)
depth[100:400, 180:240] = 2 + 0.1 * np.sin(np.linspace(0, 3, 60))
pipeline = Pipeline.from_pretrained("small", refine=True)
print(pipeline(depth, Camera(366, 366, 206, 253, 424, 512)).vertices.shape)
"""


@pytest.mark.slow
def test_an_installed_wheel_predicts_by_name_without_a_checkout(both, tmp_path):
    pytest.importorskip("setuptools", "77", reason="setuptools>=77 builds the wheel")
    source, target = tmp_path / "source", tmp_path / "target"
    ignored = shutil.ignore_patterns(".git", ".venv", "outputs", "build", "*.egg-info", "tests", "docs")
    shutil.copytree(ROOT, source, ignore=ignored)
    for name in ("small.safetensors", "index.json"):
        shutil.copy(both.parent / name, source / "ljn" / "weights")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(source)]
    subprocess.run(build, check=True)
    [wheel] = tmp_path.glob("ljn-*.whl")
    shutil.rmtree(source)
    subprocess.run([*pip, "install", "--no-deps", "--target", str(target), str(wheel)], check=True)
    done = subprocess.run(
        [sys.executable, "-c", _ELSEWHERE, str(target)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(target), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "(6890, 3)", done.stderr


def test_a_keypoint_detector_is_a_package_of_its_own_and_finds_keypoints_in_predictions(
    models, write_checkpoint, smoke_config, image, tmp_path
):
    ckpt = write_checkpoint("keypoints/cpn_depth")
    given = [f"task.keypoint_detector={ckpt}", f"task.directory={tmp_path}", "task.name=cpn"]
    cfg = smoke_config(tmp_path, "task=package", *given, "task.licence=CC0-1.0", "task.precision=half")
    assert package(cfg)["package/keypoints_rounding"] < 0.1
    path = tmp_path / "cpn.safetensors"
    assert list(said(path)["stages"]) == ["keypoints"]
    checkpoints = [f"ckpt_path={models[0]}", f"task.mesh_ckpt_path={models[1]}"]
    made = {}
    for detector in (ckpt, path):
        cfg = smoke_config(
            tmp_path, "task=predict", *image[1], *checkpoints, f"task.keypoint_detector={detector}"
        )
        predict(cfg)
        (found,) = (tmp_path / "predictions").glob("*/depth.npz")
        made[detector] = np.load(found)["keypoints"]
        summary = json.loads((found.parent / "predictions.json").read_text())
        assert summary["keypoint_detector"]["path"] == str(detector)
        assert summary["frames"]["depth"]["keypoints_found_in"] == "depth"
    assert np.median(np.abs(made[ckpt] - made[path])) < 2  # half precision
    with pytest.raises(
        ValueError, match=r"a package holds a keypoint detector or the two other stages, got both"
    ):
        package(smoke_config(tmp_path, "task=package", *given, *checkpoints, "task.licence=CC0-1.0"))


@pytest.mark.slow
def test_a_training_begins_with_a_package_s_weights_but_for_those_of_another_shape(
    write_checkpoint, smoke_config, tmp_path
):
    ckpt = write_checkpoint("keypoints/cpn_depth")
    given = [f"task.keypoint_detector={ckpt}", f"task.directory={tmp_path}", "task.name=cpn"]
    package(smoke_config(tmp_path, "task=package", *given, "task.licence=CC0-1.0", "task.precision=half"))
    # So slow that nothing is learned.
    slow = ["experiment=keypoints/cpn", "module.optimizer.lr=1e-12", "callbacks.pictures=null"]
    beginning = tmp_path / "cpn.safetensors"
    cfg = smoke_config(tmp_path, *slow, f"task.begins_with={beginning}", "seed=1")
    train(cfg)
    record = json.loads((Path(cfg.paths.run_dir) / "record.json").read_text())
    assert record["begins_with"]["path"] == str(beginning)
    first, second = (
        torch.load(path, weights_only=True)["state_dict"]
        for path in (ckpt, f"{cfg.paths.run_dir}/checkpoints/best.ckpt")
    )
    weights = "net.last.1.weight"
    torch.testing.assert_close(second[weights], first[weights].half().float())
    assert second["net.backbone.conv1.weight"].shape[1] == 3
    for name, message in (
        ("small", r"begins_with: .* holds detector and mesh alone, but no keypoints"),
        ("cpn_depth", r"begins_with: .* holds the weights of another model"),  # larger than preset=smoke
        (f"{tmp_path / 'none.ckpt'}", r"begins_with: no file"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            train(smoke_config(tmp_path, *slow, f"task.begins_with={name}"))


@pytest.mark.slow
def test_a_keypoint_detector_of_colours_needs_the_colour_image(
    models, write_checkpoint, smoke_config, image, tmp_path
):
    ckpt = write_checkpoint("keypoints/cpn")
    given = [*image[1], f"ckpt_path={models[0]}", f"task.keypoint_detector={ckpt}"]
    with pytest.raises(ValueError, match=r"task.rgb: expected a path, since the keypoint detector"):
        predict(smoke_config(tmp_path, "task=predict", *given))
    rgb = np.random.default_rng(0).integers(0, 256, (*image[0].shape, 3), dtype=np.uint8)
    Image.fromarray(rgb).save(tmp_path / "colours.jpg")
    predict(smoke_config(tmp_path, "task=predict", *given, f"task.rgb={tmp_path / 'colours.jpg'}"))
    (summary,) = (tmp_path / "predictions").glob("*/predictions.json")
    assert json.loads(summary.read_text())["frames"]["depth"]["keypoints_found_in"] == "rgb"
    Image.fromarray((1000 * image[0]).astype(np.uint16)).save(tmp_path / "deep.png")
    for name, problem in (("depth.npy", "expected one of .png"), ("deep.png", "expected 8 bits a channel")):
        with pytest.raises(ValueError, match=f"rgb: {problem}"):
            predict(smoke_config(tmp_path, "task=predict", *given, f"task.rgb={tmp_path / name}"))
