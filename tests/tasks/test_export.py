import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch

import ljn.demo
from ljn.body import SMPL, load_body_models
from ljn.geometry.camera import project
from ljn.pipeline.inputs import read_depth, read_keypoints
from ljn.pipeline.samples import find_samples, read_truth
from ljn.render import get_renderer
from ljn.tasks.export import export


def commands():
    """The commands that made the frames that ship, by their folders: their overrides."""
    text = ljn.demo.__doc__.replace("\\\n", " ")
    found = [shlex.split(line)[2:] for line in text.splitlines() if line.strip().startswith("python run.py")]
    key = "task.directory=ljn/demo/"
    return {
        argument.removeprefix(key): [other for other in overrides if other != argument]
        for overrides in found
        for argument in overrides
        if argument.startswith(key)
    }


@pytest.fixture(scope="module")
def remade(compose_config, tmp_path_factory):
    """The frames that ship, made again."""
    directory = tmp_path_factory.mktemp("remade")
    for name, overrides in commands().items():
        export(
            compose_config(*overrides, f"task.directory={directory / name}", f"paths.output_dir={directory}")
        )
    return directory


def test_the_frames_that_ship_are_what_their_commands_make(remade):
    shipped = find_samples(ljn.demo.FRAMES)
    again = {files.name: files for files in find_samples(remade)}
    assert again.keys() == {files.name for files in shipped}
    for files in shipped:
        assert files.camera == again[files.name].camera
        assert len(files.frames) >= 3
        for frame, other in zip(files.frames, again[files.name].frames, strict=True):
            assert frame.name == other.name
            depth, remade_depth = (read_depth(each.depth).astype(int) for each in (frame, other))
            # Elsewhere a pixel of the outline may fall on the other side of it.
            assert (np.abs(depth - remade_depth) > 1).sum() <= 5


def test_the_frames_that_ship_are_small():
    assert sum(path.stat().st_size for path in ljn.demo.FRAMES.rglob("*") if path.suffix != ".pyc") < 300_000


def test_the_truth_is_that_of_the_image(remade):
    for files in find_samples(remade):
        for frame, path in zip(files.frames, files.truths):
            truth = read_truth(path)
            vertices = torch.from_numpy(truth.vertices())
            faces = SMPL(load_body_models(None, [truth.gender])).faces
            rendered = get_renderer("zbuffer")(vertices[None], faces, files.camera)[0].numpy()
            depth = read_depth(frame.depth) / 1000
            assert ((rendered > 0) != (depth > 0)).sum() <= 5
            errors = np.abs(rendered - depth)[(rendered > 0) & (depth > 0)]
            assert np.quantile(errors, 0.99) < 0.004  # noise of 1 mm, and rounding
            pixels = project(torch.from_numpy(truth.joints), files.camera.intrinsics()).numpy()
            distances = np.linalg.norm(np.array(read_keypoints(frame.keypoints)) - pixels, axis=1)
            assert 5 < distances.mean() < 20  # noise of 10 px


def test_a_truth_of_another_body_is_refused(remade):
    path = find_samples(remade)[0].truths[0]
    with pytest.raises(
        ValueError, match=r"the truth belongs to the \w+ body 0123, but the one found here is"
    ):
        read_truth(path)._replace(body="0123").vertices()


def test_keypoints_that_are_missing_have_no_confidence(smoke_config, tmp_path):
    changes = ("data.synthesis.missing_keypoints=[0.5]", "task.indices=[1]")
    assert export(smoke_config(tmp_path, "task=export", *changes)) == {"export/samples": 1}
    [files] = find_samples(tmp_path / "export")
    assert files.frames[0].name == "test_1"
    confidences = np.array(read_keypoints(files.frames[0].keypoints))[:, 2]
    assert set(confidences) == {0, 1}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("task.split=all", r"task\.split: expected one of train, val, test, got 'all'"),
        ("task.indices=[]", r"task\.indices: expected numbers of samples"),
        ("task.indices=[16]", r"the test set has 16 samples, got \[16\]"),
        ("task.names=[a]", r"task\.names: expected 4 different names, got \['a'\]"),
        ("data.synthesis.focal_factors=[1,2]", "expected one camera for all samples"),
        (
            "data=rgb",
            "data: task=export writes depth images and keypoints, got colour crops; use data=synthetic",
        ),
    ],
)
def test_what_cannot_be_exported_is_named(change, message, smoke_config, tmp_path):
    with pytest.raises(ValueError, match=message):
        export(smoke_config(tmp_path, "task=export", change))


def test_samples_of_another_call_are_not_mixed_in(smoke_config, tmp_path):
    (tmp_path / "export" / "depth").mkdir(parents=True)
    (tmp_path / "export" / "depth" / "mine.png").touch()
    with pytest.raises(ValueError, match=r"task\.directory: '.*' holds other samples, such as 'mine'"):
        export(smoke_config(tmp_path, "task=export"))


def test_what_is_no_folder_of_samples_is_named(remade, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no camera\.yaml in .*task=export writes samples"):
        find_samples(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"truth: no file"):
        read_truth(tmp_path / "truth.npz")
    (tmp_path / "truth.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"truth: '.*' is damaged"):
        read_truth(tmp_path / "truth.npz")
    np.savez(tmp_path / "truth.npz", joints=np.zeros(3))
    with pytest.raises(ValueError, match=r"truth: expected the arrays"):
        read_truth(tmp_path / "truth.npz")
    for name in ("a", "b"):
        (tmp_path / name).symlink_to(Path(remade) / "kinect_v2")
    with pytest.raises(ValueError, match=re.escape("are called 'dancing'; rename one")):
        find_samples(tmp_path)
