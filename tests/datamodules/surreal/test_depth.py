import logging
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules.sources import Examinable, ImageSource
from datamodules.sources.surreal import SurrealDepthSource, SurrealSource
from datamodules.sources.surreal.bodies import ClipBodies, lengthening, radial_share
from datamodules.sources.surreal.files import read_filmed_clip
from ljn.body import SMPL
from ljn.geometry.camera import project
from ljn.geometry.rotations import body_to_camera
from ljn.render import get_renderer
from tests.datamodules.surreal.writer import (
    clip_path,
    make_clip,
    make_images,
    projection,
    write_clip,
    write_mat,
)


@pytest.fixture(autouse=True)
def bodies_read_once(surreal_bodies, monkeypatch):
    monkeypatch.setattr("datamodules.sources.surreal.filmed.load_body_models", lambda *_: surreal_bodies)


@pytest.fixture(scope="module")
def posed(surreal_bodies):
    return ClipBodies(surreal_bodies)


def findings(source, bodies, num_clips=None):
    return list(source.examine(bodies, num_clips))


def test_a_clip_of_known_bodies_agrees_with_its_camera_to_the_rounded_pixel(filmed_tree, surreal_bodies):
    source = SurrealSource(filmed_tree)
    assert isinstance(source, Examinable)
    found = findings(source, surreal_bodies)
    largest = {
        name: max(each.values.get(name, 0) for each in found) for name in ("camera_px", "body_mm", "body_px")
    }
    assert largest["camera_px"] == largest["body_px"] == 0
    assert largest["body_mm"] < 0.01
    assert not any(each.is_wrong for each in found)
    text = "\n".join(each.text for each in found)
    assert (
        "train/run0/01_01/01_01_c0001: 6 frames; camera 0.00 px; body mean 0.0, max 0.0 mm, 0.00 px" in text
    )
    assert "SURREAL was made with these" in text
    assert "0 px beyond rounding: all is well" in text
    assert len(findings(source, surreal_bodies, 2)) == 2 + 3


def test_another_body_and_another_camera_are_told_apart(tmp_path, surreal_bodies):
    write_clip(tmp_path, "test", "01_01", num_frames=6, gender=0)
    [_, _, bodies, camera] = findings(SurrealSource(tmp_path), surreal_bodies[1:])
    assert "SURREAL was made with others" in bodies.text
    assert "body=smpl body.path=FOLDER" in bodies.text
    assert "all is well" in camera.text
    fields, _ = make_clip(num_frames=6)
    flipped = fields["joints2D"] * np.array([-1, 1])[:, None, None] + np.array([320, 0])[:, None, None]
    for changes in ({"joints2D": flipped}, {"camLoc": fields["camLoc"] + 0.1}, {"camLoc": [-9, 0, 0]}):
        write_clip(tmp_path, "test", "01_01", num_frames=6, fields=changes)
        *_, camera = findings(SurrealSource(tmp_path), surreal_bodies)
        assert camera.is_wrong
        assert "beyond rounding from joints2D, expected 0" in camera.text


def test_who_walks_past_the_camera_is_no_error_of_it(tmp_path, surreal_bodies):
    fields, _ = make_clip(num_frames=40)
    place = fields["camLoc"].ravel().astype(float)
    fields["joints3D"][0] += np.linspace(0, 12, 40)  # from six metres before it to six behind
    joints = fields["joints3D"].transpose(2, 1, 0).astype(float)
    seen = np.concatenate([joints, np.ones((40, 24, 1))], -1) @ projection(place).T
    fields["joints2D"] = np.round(seen[..., :2] / seen[..., 2:]).transpose(2, 1, 0)
    write_mat(Path(f"{clip_path(tmp_path, 'test', '01_01')}_info.mat"), fields)
    *_, camera = findings(SurrealSource(tmp_path), surreal_bodies)
    assert "0 px beyond rounding: all is well" in camera.text


def test_damaged_clips_are_named_and_the_check_goes_on(tmp_path, surreal_bodies):
    for number in (1, 2, 3):
        write_clip(tmp_path, "test", "01_01", number, num_frames=6)
    fields, _ = make_clip(num_frames=6)
    del fields["joints3D"]
    write_mat(Path(f"{clip_path(tmp_path, 'test', '01_01', 2)}_info.mat"), fields)
    write_clip(tmp_path, "test", "01_01", 3, num_frames=6, fields={"joints3D": np.full((3, 24, 6), np.nan)})
    Path(f"{clip_path(tmp_path, 'test', '01_01', 4)}_info.mat").write_bytes(b"")
    found = findings(SurrealSource(tmp_path), surreal_bodies)
    text = "\n".join(each.text for each in found)
    assert "01_01_c0002_info.mat: no field joints3D" in text
    assert "c0003_info.mat: no frame of 6 is whole" in text
    assert "3 of 3 clips, 2 of them damaged; 1 other files cannot be read" in text
    assert not found[-1].is_wrong
    write_mat(Path(f"{clip_path(tmp_path, 'test', '01_01')}_info.mat"), fields)
    assert findings(SurrealSource(tmp_path), surreal_bodies)[-1].is_wrong


def test_images_turned_back_show_the_records_bodies(filmed_tree, surreal_bodies):
    source = SurrealDepthSource(filmed_tree)
    assert isinstance(source, ImageSource)
    source.check()
    assert source.is_radial
    assert source.is_of_bodies
    records = source.records("test", 6, 0)
    scene = pickle.loads(pickle.dumps(source)).scene(records, [0, 4], True)
    layer = SMPL(surreal_bodies).double()
    vertices, joints = layer(scene.pose.double(), scene.betas.double(), scene.gender)
    vertices, joints = body_to_camera(vertices), body_to_camera(joints)
    shift = (scene.joints - joints)[:, :1]
    torch.testing.assert_close(joints + shift, scene.joints, atol=1e-5, rtol=0)
    rendered = get_renderer("zbuffer")(vertices + shift, layer.faces, source.camera).numpy()
    for made, seen in zip(rendered, scene.depth):
        assert ((made > 0) != (seen > 0)).sum() <= 2
        is_both = (made > 0) & (seen > 0)
        assert np.abs(made - seen)[is_both].max() < 1e-4
    # Keypoints, in pixels from the middle of the first one, are the file's, turned back.
    pixels = project(scene.joints, source.camera.intrinsics(torch.float64))
    for row, name, found in zip([0, 4], records.sequence[[0, 4]], pixels):
        clip = read_filmed_clip(filmed_tree / "cmu" / f"{name}_info.mat")
        expected = [320, 0] + clip.pixels[records.frame[row]] * [-1, 1] - 0.5
        assert np.abs(found.numpy() - expected).max() <= 0.5 + 1e-3
    assert source.scene(records, [0], False).depth[0].shape == (0, 0)


@pytest.mark.parametrize("radial", [True, False])
def test_the_kind_of_depth_is_measured_with_other_bodies_too(radial, posed, tmp_path):
    """The bodies that are rendered differ in shape from those in the images by as much as people do."""
    measured, rendered = [], []
    for seed in range(3):
        fields, vertices = make_clip(seed, num_frames=1, gender=seed % 2, distance=6.0)
        depth, _ = make_images(fields, vertices, radial)
        [image] = depth.values()
        measured.append(np.where(image < 1e9, image, 0)[:, ::-1])
        clip = as_clip(fields, tmp_path)
        clip.betas[:] += np.random.default_rng(seed).standard_normal(10)
        rendered.append(posed.rendered(clip, np.array([0]))[0])
    assert radial_share(measured, rendered) == pytest.approx(float(radial), abs=0.25)
    assert np.isnan(radial_share([np.zeros((240, 320))], rendered[:1]))
    assert lengthening()[0, 0] == pytest.approx(np.sqrt(1 + (159.5**2 + 119.5**2) / 600**2))


def as_clip(fields, folder):
    """The clip of some fields."""
    write_mat(folder / "a.mat", fields)
    return read_filmed_clip(folder / "a.mat")


def test_a_kind_of_depth_that_cannot_be_measured_is_an_error_and_may_be_given(filmed_tree, monkeypatch):
    monkeypatch.setattr("datamodules.sources.surreal.depth.radial_share", lambda *_: 0.5)
    with pytest.raises(
        ValueError, match=r"data\.source\.radial: cannot be measured .* set data\.source\.radial=true"
    ):
        SurrealDepthSource(filmed_tree).check()
    prints = set()
    for radial in (True, False):
        source = SurrealDepthSource(filmed_tree, radial=radial)
        assert source.is_radial == radial
        prints.add(source.fingerprint)
    assert len(prints) == 2


def test_shapes_of_other_bodies_are_fitted_to_the_joints(posed, surreal_bodies, tmp_path):
    clip = as_clip(make_clip(num_frames=6, gender=0)[0], tmp_path)
    frames = np.arange(6)
    np.testing.assert_allclose(posed.joints(clip, frames), clip.joints, atol=1e-4)
    male = ClipBodies(surreal_bodies[1:])
    before = male.errors_m(clip, frames).mean()
    assert before > 0.01
    clip.betas[:] = male.fitted_betas(clip, frames)
    assert male.errors_m(clip, frames).mean() < 0.5 * before
    assert np.abs(clip.betas).max() < 4


def test_frames_whose_images_are_damaged_or_empty_are_left_out(tmp_path, caplog, surreal_bodies):
    for number in range(1, 5):
        write_clip(tmp_path, "test", "01_01", number, images=number < 3, seed=number, num_frames=6)
    first, second, third = (str(clip_path(tmp_path, "test", "01_01", number)) for number in (1, 2, 3))
    Path(f"{third}_depth.mat").write_bytes(Path(f"{first}_depth.mat").read_bytes())
    depth = Path(f"{second}_depth.mat")
    depth.write_bytes(depth.read_bytes()[:5000])
    write_mat(Path(f"{third}_segm.mat"), {f"segm_{k}": np.zeros((240, 320), np.uint8) for k in range(1, 7)})
    source = SurrealDepthSource(tmp_path, radial=True)
    with caplog.at_level(logging.WARNING):
        records = source.records("test", 9, 0)
    assert len(records) == 9
    assert set(records.sequence) == {"test/run0/01_01/01_01_c0001"}
    assert "01_01_c0002_depth.mat: " in caplog.text
    assert "6 of 9 samples of test come twice" in caplog.text
    images, *_ = findings(source, surreal_bodies)
    assert images.text.startswith("images: 6 of 18 frames of 3 of 3 clips can be used")
    fingerprint = source.fingerprint
    depth.write_bytes(Path(f"{first}_depth.mat").read_bytes())
    again = SurrealDepthSource(tmp_path, radial=True)
    assert again.fingerprint != fingerprint, "a file that was copied again is another"
    with caplog.at_level(logging.WARNING):
        SurrealDepthSource(tmp_path, radial=True).check()
    assert "left out: 1 of 4 clips, which have not all of *_info.mat, *_depth.mat, *_segm.mat" in caplog.text
    assert "there is no" in caplog.text
    assert "01_01_c0004_depth.mat" in caplog.text
    for number in (1, 2):
        depth.with_name(f"01_01_c000{number}_depth.mat").write_bytes(b"")
    with pytest.raises(ValueError, match=r"no \*_depth\.mat in .* can be read, of 3 clips"):
        SurrealDepthSource(tmp_path).check()
