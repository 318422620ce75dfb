import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import ljn.tasks.predict
from datamodules.sources.bvh import BvhSource
from ljn import SMPL, Pipeline
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.geometry.camera import project
from ljn.pipeline.frames import in_order
from ljn.pipeline.keypoint_orders import ORDERS
from ljn.render import get_renderer
from ljn.tasks.predict import predict

output_directory = ljn.tasks.predict._directory
README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="session")
def files(kinect, tmp_path_factory):
    """A user's files: a person in front of a wall, 2.3 m away, with the arms held down."""
    directory = tmp_path_factory.mktemp("files")
    body = SMPL.load()
    pose = torch.zeros(24, 3)
    pose[JOINT_INDEX["l_shoulder"], 2], pose[JOINT_INDEX["r_shoulder"], 2] = -1.1, 1.1
    vertices, joints = body(pose.flatten(), torch.zeros(10))
    upright = torch.tensor([1.0, -1, -1])  # SMPL's rest frame to camera axes
    place = torch.tensor([0.1, 0, 2.3])
    vertices, joints = ((x - joints[ROOT]) * upright + place for x in (vertices, joints))
    depth = get_renderer("zbuffer")(vertices[None], body.faces, kinect)[0].numpy()
    behind = np.where(depth > 0, depth, np.float32(3.5))
    Image.fromarray((1000 * behind).round().astype(np.uint16)).save(directory / "depth.png")
    Image.fromarray(255 * (depth > 0).astype(np.uint8)).save(directory / "mask.png")
    keypoints = project(joints, kinect.intrinsics()).numpy().astype(float)
    names = ORDERS["coco17"].names
    coco = {
        keypoint: keypoints[JOINT_INDEX[joint]].tolist()
        for joint, taken in ORDERS["coco17"].joints.items()
        for keypoint in taken
    }
    (directory / "keypoints.json").write_text(json.dumps([coco.get(name) for name in names]))
    (directory / "camera.json").write_text(json.dumps(vars(kinect)))
    return directory


@pytest.fixture
def config(smoke_config, files, checkpoints, tmp_path):
    """The configuration of a valid call, with changes as `key=value`."""

    def make(*changes):
        paths = {
            "task.input": files / "depth.png",
            "task.camera": files / "camera.json",
            "task.keypoints": files / "keypoints.json",
            "task.mask": files / "mask.png",
            "ckpt_path": checkpoints[0],
            "task.mesh_ckpt_path": checkpoints[1],
        }
        given = [f"{key}={path}" for key, path in paths.items()]
        return smoke_config(tmp_path, "task=predict", *given, *changes)

    return make


@pytest.fixture
def folders(files, tmp_path):
    """Folders of three frames with masks, the second of which is damaged; and an older output of it."""
    for name, suffix in (("depth", ".png"), ("keypoints", ".json"), ("mask", ".png")):
        (tmp_path / name).mkdir()
        for frame in ("a", "b", "c"):
            shutil.copy(files / f"{name}{suffix}", tmp_path / name / f"{frame}{suffix}")
    (tmp_path / "depth" / "b.png").write_bytes((files / "depth.png").read_bytes()[:500])
    outputs = output_directory(tmp_path, tmp_path / "depth")
    outputs.mkdir(parents=True)
    (outputs / "b.npz").write_bytes(b"of an earlier call")
    names = {"input": "depth", "keypoints": "keypoints", "mask": "mask"}
    changes = [f"task.{key}={tmp_path / name}" for key, name in names.items()]
    return changes, outputs


def test_the_command_predicts_an_image(config, files, checkpoints, run_py, tmp_path):
    done = run_py(
        *("task=predict", f"task.input={files / 'depth.png'}", f"task.camera={files / 'camera.json'}"),
        *(f"task.keypoints={files / 'keypoints.json'}", f"task.mask={files / 'mask.png'}"),
        *(f"ckpt_path={checkpoints[0]}", f"task.mesh_ckpt_path={checkpoints[1]}"),
        f"paths.output_dir={tmp_path}",
    )
    outputs = output_directory(tmp_path, files / "depth.png")
    assert {path.name for path in outputs.iterdir()} == {
        *(f"depth{suffix}" for suffix in (".npz", ".ply", ".glb", ".png")),
        "predictions.json",
    }
    summary = json.loads((outputs / "predictions.json").read_text())
    assert f"{summary['predict/median_distance_mm']:10.3f}" in done.stdout
    assert summary["frames"]["depth"]["filled_in"][0] == "pelvis"
    assert (summary["detector"]["run"], summary["regressor"]["run"]) == ("detector/proposed", "mesh/proposed")
    with np.load(outputs / "depth.npz") as arrays:
        assert arrays["vertices"].shape == (6890, 3)


def test_without_a_mesh_checkpoint_joints_alone_are_written_whatever_the_configurations_model(
    config, files, tmp_path
):
    broken = ("model.radii_m=[1]", "data.observation.num_points=0")
    assert predict(config("task.mesh_ckpt_path=null", *broken)) == {"predict/frames": 1}
    outputs = output_directory(tmp_path, files / "depth.png")
    assert {path.name for path in outputs.iterdir()} == {"depth.npz", "depth.png", "predictions.json"}


def test_a_damaged_frame_of_a_folder_is_reported_and_costs_the_others_nothing(folders, config):
    changes, outputs = folders
    message = r"1 of 3 frames failed, all others are written; the first is b: depth: .*damaged"
    with pytest.raises(ValueError, match=message):
        predict(config(*changes))
    assert {path.stem for path in outputs.glob("*.npz")} == {"a", "c"}
    summary = json.loads((outputs / "predictions.json").read_text())
    assert (summary["predict/frames"], summary["predict/failed"]) == (2, 1)
    assert "is damaged" in summary["frames"]["b"]["error"]
    # The same image twice, in one batch: apart from rounding, the same result.
    distances = [summary["frames"][name]["median_distance_mm"] for name in "ac"]
    assert distances[0] == pytest.approx(distances[1], rel=1e-4)


def test_a_folder_is_a_motion_too(folders, config, tmp_path):
    changes, outputs = folders
    with pytest.raises(ValueError, match="1 of 3 frames failed"):
        predict(config(*changes, "task.sequence=[amass,bvh]", "task.rate_hz=5"))
    about = json.loads((outputs / "predictions.json").read_text())["sequence"]
    assert (about["frames"], about["rate_hz"]) == (3, 5)
    assert 0 <= about["shape_distance_mm"] < 100
    with np.load(outputs / "sequence.npz") as arrays, np.load(outputs / "a.npz") as first:
        np.testing.assert_allclose(arrays["poses"][1, :66], first["pose"][:66], atol=1e-5)
        assert arrays["poses"].shape == (3, 156)
    [motion] = BvhSource().read(outputs / "sequence.bvh")
    np.testing.assert_allclose(motion.poses[0, 3:], np.load(outputs / "a.npz")["pose"][3:], atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("task.sequence=[fbx]", r"task\.sequence: expected some of amass, bvh, got 'fbx'"),
        ("task.rate_hz=0", r"task\.rate_hz: expected frames a second, more than 0, got 0"),
        (
            "task.mesh_ckpt_path=null",
            r"task\.sequence: a motion is of meshes, and there is no mesh regressor",
        ),
    ],
)
def test_a_motion_that_cannot_be_written_is_an_error(change, message, folders, config):
    with pytest.raises(ValueError, match=message):
        predict(config(*folders[0], "task.sequence=bvh", change))


def test_an_image_is_no_motion(config):
    with pytest.raises(
        ValueError, match=r"task\.sequence: expected a folder of frames as task\.input, got the file"
    ):
        predict(config("task.sequence=amass"))


def test_frames_of_a_motion_are_in_the_order_of_their_numbers():
    names = ["f_9", "f_10", "f_1b", "f_1", "f"]
    assert sorted(names, key=in_order) == ["f", "f_1", "f_1b", "f_9", "f_10"]


def test_keypoints_that_are_missing_for_a_frame_fail_that_frame(folders, config, tmp_path):
    changes, outputs = folders
    (tmp_path / "keypoints" / "c.json").unlink()
    with pytest.raises(ValueError, match="2 of 3 frames failed"):
        predict(config(*changes, "task.mesh_ckpt_path=null"))
    assert {path.stem for path in outputs.glob("*.npz")} == {"a"}


NEEDED = ["task.input", "task.camera", "ckpt_path"]


@pytest.mark.parametrize("key", NEEDED)
def test_what_a_prediction_needs_is_named(key, config):
    with pytest.raises(
        ValueError, match=rf"{key}: expected a path, got null; python run\.py task=predict input="
    ):
        predict(config(f"{key}=null"))


def test_keypoints_are_needed_where_the_detector_takes_them_alone(config, files, write_checkpoint, tmp_path):
    with pytest.raises(
        ValueError, match=r"task\.keypoints: expected a path, since the detector .* takes keypoints"
    ):
        predict(config("task.keypoints=null"))
    detector = write_checkpoint("detector/cascade", "model.patch_sizes_m=[0.5]")
    mesh = write_checkpoint("mesh/kinematic", "model.channels=16")
    changes = ("task.keypoints=null", f"ckpt_path={detector}", f"task.mesh_ckpt_path={mesh}")
    assert predict(config(*changes))["predict/frames"] == 1
    with np.load(output_directory(tmp_path, files / "depth.png") / "depth.npz") as arrays:
        assert {"joints", "vertices", "points"} <= set(arrays) - {
            "keypoints",
            "initial_joints",
            "confidences",
        }
        assert arrays["vertices"].shape == (6890, 3)


def test_a_number_is_no_path(config):
    with pytest.raises(
        ValueError, match=r"task\.input: expected a path, got 20230401, .*'task\.input=\"PATH\"'"
    ):
        predict(config("task.input=2023_04_01"))


@pytest.mark.parametrize("key", [*NEEDED, "task.keypoints", "task.mask", "task.mesh_ckpt_path"])
def test_a_missing_file_is_an_error(key, config):
    with pytest.raises(FileNotFoundError, match=r"no file .*'nowhere\.x'"):
        predict(config(f"{key}=nowhere.x"))


def test_nothing_is_loaded_before_the_cheap_checks(config, folders, monkeypatch, tmp_path):
    monkeypatch.setattr(ljn.tasks.predict, "Pipeline", None)
    changes, _ = folders
    message = "files or folders alike, got: input is a folder, keypoints is a folder, mask is a file"
    with pytest.raises(ValueError, match=message):
        predict(config(*changes[:2]))
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no depth image \(\.png, \.npy, \.npz\) in"):
        predict(config(*changes[1:], f"task.input={tmp_path / 'empty'}"))
    (tmp_path / "depth" / "a.npy").touch()
    with pytest.raises(ValueError, match=r"'a.npy' and 'a.png' would write the same outputs"):
        predict(config(*changes))


def test_checkpoints_that_changed_places_are_refused(checkpoints):
    with pytest.raises(
        ValueError, match=r"detector_ckpt: expected the checkpoint of a JointDetector.*changed places"
    ):
        Pipeline.load(*reversed(checkpoints))
    with pytest.raises(ValueError, match="mesh_ckpt: expected the checkpoint of a MeshRegressor"):
        Pipeline.load(checkpoints[0], checkpoints[0])


def with_body_hash(path, body_hash, target):
    content = torch.load(path, weights_only=True)
    content["ljn"]["body_hash"] = body_hash
    torch.save(content, target)
    return target


def test_checkpoints_of_different_bodies_are_refused(checkpoints, tmp_path):
    detector, mesh = checkpoints
    other = with_body_hash(detector, "0123456789abcdef", tmp_path / "other.ckpt")
    with pytest.raises(
        ValueError, match=r"0123456789abcdef of '.*other.ckpt' is not among them.*same bodies"
    ):
        Pipeline.load(other, mesh)
    hashes = torch.load(detector, weights_only=True)["ljn"]["body_hash"]
    older = with_body_hash(mesh, hashes, tmp_path / "older.ckpt")  # the neutral body was another one
    with pytest.raises(ValueError, match=r"mesh_ckpt: .*but the body found here is [0-9a-f]{16}"):
        Pipeline.load(detector, older)


def test_the_pipeline_takes_points_and_normals_from_the_checkpoints(checkpoints):
    pipeline = Pipeline.load(*checkpoints)
    recipe = pipeline.detector.recipe
    assert (recipe.num_points, recipe.normals) == (128, "window")
    assert recipe.spacing_m == pytest.approx(1.5 / 366.458)
    assert not pipeline.regressor.module.training


def test_the_readme_s_example_runs(files, kinect, monkeypatch, tmp_path):
    text = README.read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    [example] = [block for block in blocks if "Pipeline.from_pretrained" in block]
    monkeypatch.chdir(tmp_path)
    depth = np.asarray(Image.open(files / "depth.png"))
    depth = np.where(np.asarray(Image.open(files / "mask.png")) > 0, depth, 0)
    names = {"depth": depth, **vars(kinect)}
    exec(example, names)
    prediction = names["prediction"]
    shapes = (prediction.joints.shape, prediction.vertices.shape, prediction.pose.shape)
    assert shapes == ((24, 3), (6890, 3), (72,))


def test_inputs_of_one_name_have_folders_of_their_own_and_nothing_of_an_earlier_call(
    folders, config, files, tmp_path
):
    changes, outputs = folders
    places = [tmp_path / person / "depth" for person in ("alice", "bob")]
    for place in places:
        place.mkdir(parents=True)
    directories = {output_directory(tmp_path, place) for place in (*places, tmp_path / "depth")}
    assert len(directories) == 3
    assert {path.name.rpartition("-")[0] for path in directories} == {"depth"}
    assert output_directory(tmp_path, tmp_path / "alice" / ".." / "depth") == outputs
    (tmp_path / "depth" / "b.png").unlink()
    (outputs / "of_a_frame_that_is_gone.glb").write_bytes(b"")
    predict(config(*changes))
    assert not list(outputs.glob("b.*")) + list(outputs.glob("of_a_frame*"))
    assert len(list(outputs.glob("*.npz"))) == 2
