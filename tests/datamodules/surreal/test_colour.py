import logging
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from datamodules.rgb import Background, FrameSynthesizer, Photography, RgbDataModule, RgbSettings
from datamodules.sources import FrameSource
from datamodules.sources.surreal import SurrealDepthSource, SurrealRgbSource, SurrealSource
from datamodules.sources.surreal.video import read_video
from ljn.body import SMPL
from ljn.body.skeleton import JOINT_INDEX, MIRROR
from ljn.cloud.rgb import RgbRecipe, crop_rgb
from ljn.geometry.camera import project
from ljn.geometry.rotations import body_to_camera
from tests.datamodules.surreal.conftest import write_plain
from tests.datamodules.surreal.writer import (
    MARKERS,
    clip_path,
    make_clip,
    make_images,
    make_pictures,
    person_grey,
    write_clip,
    write_mat,
    write_video,
)

UPRIGHT = RgbSettings().without_variation()
RECIPE = RgbRecipe(128, 96)
KEYS = [(0, index) for index in range(8)]


@pytest.fixture(autouse=True)
def bodies_read_once(surreal_bodies, monkeypatch):
    monkeypatch.setattr("datamodules.sources.surreal.filmed.load_body_models", lambda *_: surreal_bodies)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Three clips in colour, of training and of test."""
    root = tmp_path_factory.mktemp("colour")
    for number, (split, sequence) in enumerate(
        [("train", "01_01"), ("test", "02_01"), ("test", "ung_03_02")]
    ):
        write_clip(root, split, sequence, video=True, seed=number, num_frames=6, distance=6.0)
    return root


@pytest.fixture(scope="module")
def make(tree, surreal_bodies):
    """Builds a synthesizer of eight records of the test split; upright crops on black unless told."""

    def build_one(settings=UPRIGHT, kind="black"):
        source = SurrealRgbSource(tree)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("datamodules.sources.surreal.filmed.load_body_models", lambda *_: surreal_bodies)
            records = source.records("test", 8, 0)
        given = (records, surreal_bodies, source.camera, settings, RECIPE, Background(kind), (0, 0))
        return FrameSynthesizer(source, *given)

    return build_one


@pytest.fixture
def make_module(tree, tmp_path):
    def make_one(source=None, **changes):
        arguments = {
            "source": source or SurrealRgbSource(tree), "camera": SurrealRgbSource.camera, "synthesis": RgbSettings(),
            "recipe": RgbRecipe(32, 32), "background": Background(), "num_train": 4, "num_val": 2, "num_test": 2,
            "batch_size": 2, "seed": 0, "pool_seed": 0, "eval_seed": 0, "num_workers": 0, "cache_dir": tmp_path,
        }  # fmt: skip
        return RgbDataModule(**{**arguments, **changes})

    return make_one


def is_seen(batch):
    """Where pixels are not black `(B, h, w)`."""
    return batch["rgb"].amax(1) > 20


def marks(batch, name):
    """Where the colour of a wrist is seen, `(B, h, w)`."""
    red, _, blue = batch["rgb"].int().unbind(1)
    return red - blue > 60 if MARKERS[name][0] > 100 else blue - red > 60


@pytest.mark.parametrize(
    "settings", [UPRIGHT, replace(RgbSettings(), mirrored=0), replace(RgbSettings(), mirrored=1)],
    ids=["fixed", "training", "mirrored"],
)  # fmt: skip
def test_each_wrist_has_its_colour_where_the_joint_of_its_side_projects(make, settings):
    """Of an image that is not turned back, or not in the same way as joints are, sides or places would differ."""
    batch = make(settings).batch(KEYS)
    pixels = project(batch["joints"], batch["rgb_camera"])
    found = 0
    for name in MARKERS:
        # In a mirrored sample, the left wrist is what was the right one.
        shown = name if not settings.mirrored else {"l_wrist": "r_wrist", "r_wrist": "l_wrist"}[name]
        for mark, place in zip(marks(batch, shown), pixels[:, JOINT_INDEX[name]]):
            rows, columns = mark.nonzero().unbind(1)
            if len(rows) < 12:
                continue  # hidden, or out of the crop
            found += 1
            centre = torch.stack([columns.float().mean(), rows.float().mean()])
            assert (centre - place).norm() < 3, name
    assert found >= 8


def test_joints_lie_on_the_person_and_what_is_outside_of_the_mask_is_black(make):
    batch = make().batch(KEYS)
    seen = is_seen(batch)
    inside = []
    for image, pixels in zip(seen, project(batch["joints"], batch["rgb_camera"]).round().long()):
        inside += [bool(image[v, u]) for u, v in pixels.tolist() if 0 <= v < 128 and 0 <= u < 96]
    assert len(inside) > 0.95 * 8 * 24
    assert np.mean(inside) > 0.95
    green = batch["rgb"][:, 1].int() - batch["rgb"][:, 0]
    assert (green > 60).float().mean() < 0.005  # of the wall, a rim at most


def test_a_fixed_crop_is_that_of_prediction(make, tree):
    synthesizer = make()
    batch = synthesizer.batch(KEYS[:4])
    _, frames = synthesizer.source.filmed(synthesizer.records, range(4))
    for crop, camera, frame in zip(batch["rgb"], batch["rgb_camera"], frames):
        expected, intrinsics = crop_rgb(frame.rgb, frame.mask, synthesizer.camera, RECIPE)
        # There windows are of whole pixels, which are some three of the crop's.
        np.testing.assert_allclose(camera, intrinsics, rtol=0.03, atol=3)
        assert np.abs(crop.numpy().astype(int) - expected).mean() < 8


class Ramp:
    """Frames of a source whose red is the column and whose green the row; not rounded to whole numbers."""

    def __init__(self, source):
        self.source = source

    def filmed(self, records, rows):
        scene, frames = self.source.filmed(records, rows)
        v, u = np.mgrid[:240, :320]
        ramp = np.stack([u, v, 0 * u], -1).astype(np.float32)
        return scene, [frame._replace(rgb=ramp) for frame in frames]


@pytest.mark.parametrize("settings", [UPRIGHT, RgbSettings(mirrored=0), RgbSettings(mirrored=1)],
                         ids=["fixed", "training", "mirrored"])  # fmt: skip
def test_a_crop_shows_at_a_joint_what_the_frame_does(make, settings):
    synthesizer = make(settings, "own")
    scene, _ = synthesizer.source.filmed(synthesizer.records, range(8))
    synthesizer.source = Ramp(synthesizer.source)
    batch = synthesizer.batch(KEYS)
    order = list(MIRROR) if settings.mirrored else slice(None)
    expected = project(scene.joints[:, order], synthesizer.camera.intrinsics(torch.float64))
    errors = []
    for image, pixels, places in zip(
        batch["rgb"].numpy(), project(batch["joints"], batch["rgb_camera"]), expected
    ):
        red, green = image[:2]
        for (u, v), place in zip(pixels.tolist(), places.numpy()):
            if 1 < u < 94 and 1 < v < 126:
                seen = [cv2.getRectSubPix(channel, (1, 1), (u, v)).item() for channel in (red, green)]
                errors.append(seen - place)
    assert len(errors) > 100
    assert np.abs(errors).max() < 0.05


def test_backgrounds(make):
    black, own, wild = (make(kind=kind).batch(KEYS) for kind in ("black", "own", "random"))
    seen = is_seen(black)
    around = torch.nn.functional.max_pool2d(seen.float(), 9, 1, 4) == 0
    inside = torch.nn.functional.max_pool2d((~seen).float(), 9, 1, 4) == 0
    red, green, _ = own["rgb"].movedim(1, 0).int()
    for batch in (own, wild):
        same = (batch["rgb"].int() - black["rgb"]).abs().amax(1)[inside] <= 2
        assert same.float().mean() > 0.99  # but for slits between limbs
        assert not torch.equal(batch["rgb"], black["rgb"])
    is_wall = around & (green > 30)  # black outside of the frame
    assert is_wall.sum() > 0.5 * around.sum()
    assert ((green - red)[is_wall] > 20).all()
    # Turned back, the wall grows darker to the right.
    columns = torch.arange(96).expand_as(green)
    for k in range(8):
        pair = torch.stack([columns[k][is_wall[k]], green[k][is_wall[k]]]).double()
        assert torch.corrcoef(pair)[0, 1] < -0.9
    assert wild["rgb"].amax(1)[around].float().std() > 10


def test_a_batch_is_like_a_rendered_one_and_depends_on_its_keys_alone(make):
    synthesizer = make(RgbSettings())
    batch = synthesizer.batch(KEYS)
    sent = pickle.loads(pickle.dumps(synthesizer)).batch([KEYS[5], KEYS[2]])
    for name, value in batch.items():
        assert torch.equal(value[[5, 2]], sent[name]), name
    other = synthesizer.batch([(1, index) for _, index in KEYS])
    assert (other["rgb"] != batch["rgb"]).flatten(1).any(1).all()
    assert batch["rgb"].shape == (8, 3, 128, 96)
    assert batch["joints"].dtype == batch["pose"].dtype == torch.float32


@pytest.mark.parametrize("settings", [UPRIGHT, RgbSettings(mirrored=1)], ids=["fixed", "mirrored"])
def test_pose_and_shape_give_the_joints(make, settings, surreal_bodies):
    batch = make(settings).batch(KEYS)
    joints = body_to_camera(SMPL(surreal_bodies)(batch["pose"], batch["betas"], batch["gender"]).joints)
    own = batch["joints"]
    torch.testing.assert_close(joints - joints[:, :1], own - own[:, :1], atol=1e-4, rtol=0)


# Files


def test_frames_of_a_video_are_those_of_their_numbers(tmp_path):
    fields, vertices = make_clip(num_frames=7)
    _, parts = make_images(fields, vertices)
    pictures = make_pictures(fields, parts)
    write_video(tmp_path / "a.mp4", pictures)
    for frames in ([0], [6], [5, 1, 5], range(7)):
        for frame, image in zip(frames, read_video(tmp_path / "a.mp4", frames, 7), strict=True):
            assert np.abs(image.astype(int) - pictures[frame]).mean() < 4
            is_person = parts[f"segm_{frame + 1}"] > 0
            assert np.median(image[is_person]) == pytest.approx(person_grey(frame), abs=6)


def test_a_video_of_one_frame_is_read(tmp_path):
    write_video(tmp_path / "a.mp4", np.full((1, 240, 320, 3), 90, np.uint8))
    [image] = read_video(tmp_path / "a.mp4", [0], 1)
    assert np.abs(image.astype(int) - 90).max() < 8


def test_a_damaged_video_is_named_with_what_is_wrong(tmp_path):
    path = tmp_path / "a.mp4"
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (8, 30, 40, 3), np.uint8).repeat(8, 1).repeat(8, 2)
    write_video(path, noise)
    whole = path.read_bytes()
    with pytest.raises(ValueError, match=r"a\.mp4: .*expected the 9 frames of its _info\.mat, got 8"):
        read_video(path, [0], 9)
    with pytest.raises(ValueError, match=r"a\.mp4: .*expected the 7 frames"):
        read_video(path, [0], 7)
    start = whole.index(b"mdat") + len(whole) // 2
    scratched = whole[:start] + rng.bytes(300) + whole[start + 300 :]
    for content in (b"", b"#EXTM3U\nhttp://localhost/a.ts\n", whole[: len(whole) // 2], scratched):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.mp4: .*; copy it again"):
            read_video(path, [7], 8)
    write_video(path, noise[:, :120])
    with pytest.raises(
        ValueError, match=r"expected images of \(240, 320\) \(height, width\), got \(120, 320\)"
    ):
        read_video(path, [0], 8)
    with pytest.raises(FileNotFoundError, match=r"b\.mp4: no such file"):
        read_video(tmp_path / "b.mp4", [0], 8)


def test_clips_without_a_whole_video_or_a_body_are_left_out_and_named(tmp_path, caplog):
    for number in range(1, 5):
        write_clip(tmp_path, "test", "01_01", number, video=number != 4, seed=number, num_frames=6)
    first, second, third = (
        Path(f"{clip_path(tmp_path, 'test', '01_01', number)}.mp4") for number in (1, 2, 3)
    )
    fields, vertices = make_clip(2, num_frames=5)
    write_video(second, make_pictures(fields, make_images(fields, vertices)[1]))
    write_mat(
        third.with_name("01_01_c0003_segm.mat"),
        {f"segm_{k}": np.zeros((240, 320), np.uint8) for k in range(1, 7)},
    )
    with caplog.at_level(logging.WARNING):
        records = SurrealRgbSource(tmp_path).records("test", 9, 0)
    assert set(records.sequence) == {"test/run0/01_01/01_01_c0001"}
    assert "01_01_c0002.mp4: cannot be used as a clip's video (expected the 6 frames" in caplog.text
    assert "left out: 1 of 4 clips, which have not all of *_info.mat, *.mp4, *_segm.mat" in caplog.text
    assert "01_01_c0004.mp4" in caplog.text
    write_plain(tmp_path, "train", "02_01")
    with pytest.raises(
        ValueError, match=r"no usable clip for 'train' .* \(\*_info\.mat, \*\.mp4, \*_segm\.mat\)"
    ):
        SurrealRgbSource(tmp_path).records("train", 9, 0)
    with pytest.raises(
        ValueError, match=r"none has .* all of its files \(\*_info\.mat, \*_depth\.mat, \*_segm"
    ):
        SurrealDepthSource(tmp_path).check()
    first.write_bytes(b"")
    with pytest.raises(ValueError, match=r"no \*\.mp4 in .* can be read, of 3 clips"):
        SurrealRgbSource(tmp_path).check()


# The data module


def test_a_module_of_frames_trains_and_keeps_fixed_sets(make_module, caplog):
    caplog.set_level(logging.INFO)
    data = make_module()
    assert isinstance(data.source, FrameSource)
    data.prepare_data()
    assert (
        "heading, distance_m, margin_px and focal_factors of data.synthesis, are of no effect" in caplog.text
    )
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert [batch["rgb"].shape for batch in batches] == [(2, 3, 32, 32)] * 2
    [fixed] = data.val_dataloader()
    examples, crops = data.examples("val", [0, 1])
    assert torch.equal(crops, fixed["rgb"])
    assert torch.equal(examples["joints"], fixed["joints"])
    about = data.describe(("val",))
    assert about["source"] == "surreal_rgb"
    assert "SURREAL" in about["licence"]
    keys = {make_module(background=Background(kind)).fixed_key("val") for kind in ("black", "own", "random")}
    assert len(keys) == 3


def test_what_cannot_be_given_to_frames_or_asked_of_other_sources_is_refused(make_module, tree):
    with pytest.raises(ValueError, match=r"photo: expected null with 'surreal_rgb'.* set data/photo=plain"):
        make_module(photo=Photography({}))
    with pytest.raises(
        ValueError, match=r"background\.kind: 'own' .*'surreal' has none; choose one of black, random"
    ):
        make_module(SurrealSource(tree), background=Background("own"))
    with pytest.raises(ValueError, match=r"'surreal_depth', which has depth images; use data=synthetic"):
        make_module(SurrealDepthSource(tree))
