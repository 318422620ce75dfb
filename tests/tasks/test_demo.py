import re
import shutil

import numpy as np
import pytest
from PIL import Image

from ljn.demo import FRAMES
from ljn.tasks.demo import demo

ROOT = FRAMES.parents[1]
NAMES = ("dancing", "running")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """One of the frames that ship for each of the two cameras."""
    directory = tmp_path_factory.mktemp("frames")
    for path in FRAMES.glob("*/*/*"):
        if path.stem in NAMES:
            target = directory / path.relative_to(FRAMES)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
            shutil.copy(path.parents[1] / "camera.yaml", target.parents[1])
    return directory


@pytest.fixture(scope="module")
def own_weights(write_checkpoint):
    """A call's checkpoints of untrained networks that can do without keypoints."""
    detector = write_checkpoint("detector/cascade", "model.patch_sizes_m=[0.5]")
    mesh = write_checkpoint("mesh/kinematic", "model.channels=16")
    return f"ckpt_path={detector}", f"task.mesh_ckpt_path={mesh}"


def test_the_demonstration_leaves_pictures_meshes_and_a_table(
    smoke_config, frames, own_weights, tmp_path, capsys
):
    demo(smoke_config(tmp_path, "task=demo", f"task.directory={frames}", *own_weights))
    outputs = tmp_path / "demo"
    assert {path.name for path in outputs.iterdir()} == {
        *(f"{name}{suffix}" for name in NAMES for suffix in (".png", ".npz", ".glb")),
        *("overview.png", "turntable.gif", "table.md"),
    }
    with np.load(outputs / "running.npz") as arrays:
        assert arrays["vertices"].shape == (6890, 3)
        assert arrays["camera"][-2:].tolist() == [640, 480]
        assert "keypoints" not in arrays
    with Image.open(outputs / "turntable.gif") as turntable:
        assert turntable.n_frames == 24
    assert (outputs / "turntable.gif").stat().st_size < 1_500_000
    with Image.open(outputs / "overview.png") as overview:
        assert min(overview.size) > 300

    printed = capsys.readouterr().out
    table = (outputs / "table.md").read_text()
    assert printed.startswith(table)
    rows = [re.split(r"\s*\|\s*", line.strip("| ")) for line in table.splitlines()]
    assert [row[:2] for row in rows[2:]] == [
        ["dancing", "kinect_v2"],
        ["running", "realsense_d435"],
        ["mean", ""],
    ]
    numbers = np.array([row[2:] for row in rows[2:]], float)
    assert (numbers > 0).all()
    assert numbers[:2].mean(0) == pytest.approx(numbers[2], abs=1)
    assert "python run.py task=predict input=" in printed
    assert "make train-demo" in printed


def test_weights_that_do_not_fit_the_demonstration_are_refused(
    smoke_config, frames, own_weights, checkpoints, tmp_path
):
    folder = f"task.directory={frames}"
    with pytest.raises(ValueError, match=r"task\.mesh_ckpt_path: expected a path, got None; give both"):
        demo(smoke_config(tmp_path, "task=demo", folder, own_weights[0]))
    given = (f"ckpt_path={checkpoints[0]}", f"task.mesh_ckpt_path={checkpoints[1]}")
    with pytest.raises(ValueError, match=r"takes keypoints, .*experiment=detector/cascade"):
        demo(smoke_config(tmp_path, "task=demo", folder, *given))


def test_make_demo_shows_the_weights_that_ship_and_make_train_demo_trains():
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^demo: install\n\t.*run\.py task=demo refine=true$", makefile, re.MULTILINE)
    assert re.search(r"^train-demo: install\n\t.*run\.py sweep=demo$", makefile, re.MULTILINE)


def test_the_weights_of_a_demonstration_may_be_named(smoke_config, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        demo(smoke_config(tmp_path, "task=demo", "weights=nowhere.safetensors"))
