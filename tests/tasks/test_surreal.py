"""SURREAL by overrides alone: checked, trained on, evaluated on, swept."""

import json
from pathlib import Path

import pytest

from datamodules.sources.surreal import SurrealDepthSource, SurrealSource
from ljn.building import build
from ljn.runs.checkpoints import read_checkpoint
from ljn.runs.packages import find_package
from ljn.tasks.check import check
from ljn.tasks.evaluate import evaluate_checkpoint
from ljn.tasks.overrides import with_checkpoint_config
from ljn.tasks.train import train
from tests.datamodules.surreal.writer import write_clip


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Two clips, of training and of test."""
    root = tmp_path_factory.mktemp("surreal")
    for split, sequence in (("train", "01_01"), ("test", "03_01")):
        write_clip(root, split, sequence, num_frames=6)
    return root


@pytest.fixture(scope="module")
def larger_tree(tmp_path_factory):
    """Twelve clips: of two subjects of training, and, with images, of one of test."""
    root = tmp_path_factory.mktemp("larger_surreal")
    for number in range(1, 13):
        is_test = number > 6
        sequence = "03_01" if is_test else f"0{1 + number % 2}_01"
        split = "test" if is_test else "train"
        write_clip(root, split, sequence, number, images=is_test, seed=number, num_frames=6, distance=5.0)
    return root


def chosen(tree, source="surreal"):
    return f"data/source={source}", f"data.source.path={tree}"


def test_the_check_prints_a_line_for_each_clip_and_what_they_say_together(
    tree, smoke_config, tmp_path, capsys
):
    metrics = check(smoke_config(tmp_path, "task=check", *chosen(tree), "task.num_clips=2"))
    assert metrics["check/camera_px"] == metrics["check/damaged"] == 0
    assert metrics["check/body_mm"] < 0.01
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "train/run0/01_01/01_01_c0001", "test/run0/03_01/03_01_c0001",
        "2 of 2 clips, 0 of them damaged; 0 other files cannot be read", "bodies", "camera",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"task\.num_clips: expected 1 or more, or null for all, got 0"):
        check(smoke_config(tmp_path, "task=check", *chosen(tree), "task.num_clips=0"))
    with pytest.raises(FileNotFoundError, match=r"data\.source\.path: expected the folder of SURREAL"):
        check(smoke_config(tmp_path, "task=check", "data/source=surreal"))


def test_what_is_wrong_is_an_error_after_all_else_is_said(smoke_config, tmp_path, capsys):
    write_clip(tmp_path, "test", "01_01", num_frames=6, fields={"camLoc": [9.0, 0, 0]})
    with pytest.raises(ValueError, match="data: camera: joints3D fall"):
        check(smoke_config(tmp_path, "task=check", *chosen(tmp_path)))
    assert "bodies: the joints of the loaded bodies" in capsys.readouterr().out


def test_a_check_of_poses_without_anything_to_compare_says_so(smoke_config, tmp_path, capsys):
    assert check(smoke_config(tmp_path, "task=check")) == {}
    assert "What is not named above is whole" in capsys.readouterr().out


def test_the_index_lies_in_the_data_modules_cache(smoke_config, tmp_path, tree):
    datamodule = build(smoke_config(tmp_path, *chosen(tree)).data)
    assert isinstance(datamodule.source, SurrealSource)
    datamodule.prepare_data()
    assert [path.suffix for path in datamodule.cache_dir.iterdir()] == [".jsonl"]


def test_an_evaluation_may_choose_the_source_and_has_the_checkpoints_bodies(smoke_config, tmp_path, tree):
    checkpoint = read_checkpoint(find_package("small", "weights"), stage="mesh")
    typed = [*chosen(tree, "surreal_depth"), "data.source.radial=true"]
    merged = with_checkpoint_config(smoke_config(tmp_path, *typed), checkpoint, typed)
    assert (merged.data.source.path, merged.data.source.radial) == (str(tree), True)
    assert merged.data.source.genders == checkpoint.config["body"]["genders"]
    assert merged.data.observation.num_points == checkpoint.config["data"]["observation"]["num_points"]
    assert isinstance(build(merged.data).source, SurrealDepthSource)


@pytest.mark.slow
def test_weights_are_evaluated_on_surreals_own_images(smoke_config, tmp_path, larger_tree):
    path = find_package("small", "weights")
    errors = {}
    for stage in ("detector", "mesh"):
        call = (
            "task=evaluate",
            "weights=small",
            f"task.stage={stage}",
            *chosen(larger_tree, "surreal_depth"),
        )
        typed = [*chosen(larger_tree, "surreal_depth"), "data.num_test=16", "data.num_workers=0"]
        errors |= {stage: evaluate_checkpoint(smoke_config(tmp_path, *call), path, typed, stage=stage)}
    # Wrong sides or a wrong camera would cost some 200 mm.
    assert errors["detector"]["test/mpjpe"] < 120
    assert errors["mesh"]["test/mpjpe_camera"] < 120
    assert errors["mesh"]["test/apve_camera"] < 150
    for path in (tmp_path / "evaluations").glob("*/record.json"):
        assert json.loads(path.read_text())["data"]["source"] == "surreal_depth"


@pytest.mark.slow
def test_a_table_is_trained_on_surreal(run_py, tmp_path, larger_tree):
    done = run_py(
        *(
            "sweep=table_3_2",
            "experiment=detector/basic,detector/simple_baseline",
            "preset=smoke",
            *chosen(larger_tree),
        ),
        *(f"paths.output_dir={tmp_path}", "logger=csv", "data.num_workers=0"),
    )
    assert "2 jobs" in done.stdout
    [table] = (tmp_path / "sweeps").glob("*/table.md")
    assert "surreal" in table.read_text()


@pytest.fixture(scope="module")
def tree_in_colour(tmp_path_factory):
    """Two clips with colour frames, of training and of test."""
    root = tmp_path_factory.mktemp("surreal_in_colour")
    for split, sequence in (("train", "01_01"), ("test", "03_01")):
        write_clip(root, split, sequence, video=True, num_frames=6)
    return root


@pytest.mark.slow
def test_keypoints_are_trained_on_surreals_frames_and_evaluated_on_them(
    smoke_config, tmp_path, tree_in_colour
):
    frames = [*chosen(tree_in_colour, "surreal_rgb"), "data/photo=plain"]
    small = (
        "data.num_workers=0",
        "data.num_train=8",
        "data.num_val=4",
        "data.num_test=4",
        "data.batch_size=4",
    )
    cfg = smoke_config(tmp_path, "experiment=keypoints/cpn", *frames, *small, "trainer.max_epochs=1")
    trained = train(cfg)
    path = Path(cfg.paths.run_dir) / "checkpoints" / "best.ckpt"
    assert "SURREAL" in read_checkpoint(path, stage="keypoints").data_licence
    again = evaluate_checkpoint(smoke_config(tmp_path, "task=evaluate"), path, [], stage="keypoints")
    assert again == {name: value for name, value in trained.items() if name.startswith("test/")}
    typed = ["data=rgb", "data.background.kind=own"]
    call = smoke_config(tmp_path, "task=evaluate", *typed)
    own = evaluate_checkpoint(call, path, typed, stage="keypoints")
    assert own["test/keypoint_error_px"] != again["test/keypoint_error_px"]


@pytest.mark.slow
def test_a_checkpoint_of_rendered_people_is_evaluated_on_frames_without_photographs(
    write_checkpoint, smoke_config, tmp_path, tree_in_colour
):
    path = write_checkpoint("keypoints/cpn")
    typed = ["data=rgb", *chosen(tree_in_colour, "surreal_rgb"), "data.num_test=4", "data.num_workers=0"]
    call = smoke_config(tmp_path, "task=evaluate", *typed)
    with pytest.raises(ValueError, match="photo: expected null with 'surreal_rgb'"):
        evaluate_checkpoint(call, path, typed, stage="keypoints")
    typed.append("data/photo=plain")
    call = smoke_config(tmp_path, "task=evaluate", *typed)
    assert evaluate_checkpoint(call, path, typed, stage="keypoints")["test/keypoint_error_px"] > 0
    [record] = (tmp_path / "evaluations").glob("*/record.json")
    assert json.loads(record.read_text())["data"]["source"] == "surreal_rgb"


def test_frames_in_colour_are_no_data_of_depth(smoke_config, tmp_path, tree_in_colour):
    with pytest.raises(ValueError, match=r"'surreal_rgb', which has frames in colour; use data=rgb"):
        build(smoke_config(tmp_path, *chosen(tree_in_colour, "surreal_rgb")).data)
