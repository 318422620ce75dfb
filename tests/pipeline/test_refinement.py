import numpy as np
import pytest
import torch

from ljn.cloud.observation import MIRRORED, mirror_observations
from ljn.demo import FRAMES
from ljn.pipeline.frames import FrameFiles
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.samples import find_samples, pseudo_label, read_truth, write_camera, write_sample
from ljn.refinement import Refined, refine


@pytest.fixture(scope="module")
def shipped():
    return Pipeline.from_pretrained(refine=True)


def frames():
    for files in find_samples(FRAMES):
        for frame, truth in zip(files.frames, files.truths):
            yield files.camera, FrameFiles.read(frame), read_truth(truth)


def error_mm(prediction, truth):
    return 1000 * np.linalg.norm(prediction.vertices - truth.vertices(), axis=-1).mean()


def test_meshes_of_the_frames_that_ship_come_nearer_to_the_truth(shipped):
    raw = Pipeline(shipped.detector, shipped.regressor)
    errors = []
    for camera, images, truth in frames():
        guessed, fitted = (each(images.depth, camera, mask=images.mask) for each in (raw, shipped))
        assert guessed.is_refined is None
        assert fitted.is_refined
        assert fitted.residual_mm[1] < fitted.residual_mm[0]
        assert fitted.mesh_joints.shape == (24, 3)
        errors.append([error_mm(guessed, truth), error_mm(fitted, truth)])
    before, after = np.mean(errors, 0)
    assert after < 0.75 * before


def test_a_good_fit_becomes_a_label(shipped, tmp_path):
    camera, images, truth = next(frames())
    found = shipped(images.depth, camera)
    body = shipped.regressor.module.body
    label = pseudo_label(found, body)
    assert label.gender == "neutral"
    np.testing.assert_allclose(label.vertices(), found.vertices, atol=1e-5)
    assert np.linalg.norm(label.joints - truth.joints, axis=-1).mean() < 0.04
    write_camera(tmp_path, camera)
    write_sample(tmp_path, "labelled", images.depth, np.zeros((24, 2)).tolist(), label)
    np.testing.assert_array_equal(read_truth(tmp_path / "truth" / "labelled.npz").pose, label.pose)
    assert pseudo_label(found, body, max_residual_mm=0.01) is None
    with pytest.raises(ValueError, match="expected one of a pipeline that refines"):
        pseudo_label(Pipeline(shipped.detector, shipped.regressor)(images.depth, camera), body)
    with pytest.raises(ValueError, match="got a batch of 2"):
        pseudo_label(shipped(np.stack([images.depth] * 2), camera), body)


def test_a_batch_is_refined_as_its_images_are(shipped):
    camera, images, _ = next(frames())
    batch = shipped(np.stack([images.depth, images.depth[:, ::-1]]), camera)
    one = shipped(images.depth, camera)
    np.testing.assert_allclose(batch[0].vertices, one.vertices, atol=0.003)
    assert batch.is_refined.shape == (2,)
    assert batch.residual_mm.shape == (2, 2)


def test_there_has_to_be_a_mesh_to_refine(shipped):
    with pytest.raises(ValueError, match="refine: True fits meshes, and there is no mesh regressor"):
        Pipeline(shipped.detector, refine=True)
    with pytest.raises(ValueError, match="refine: expected true, false, accurate or fast, got 'best'"):
        Pipeline(shipped.detector, shipped.regressor, refine="best")


def test_twice_mirrored_is_as_it_was(shipped):
    camera, images, _ = next(frames())
    frame = shipped.observe(images.depth, camera, images.keypoints)
    seen = {
        name: torch.from_numpy(np.asarray(value))[None]
        for name, value in frame.detector.items()
        if name in MIRRORED
    }
    once = mirror_observations(seen)
    assert set(once) == {"points", "crop", "crop_camera", "confidences", "initial_joints"}
    for name, value in mirror_observations(once).items():
        assert torch.equal(value, seen[name])
    u, v = 40, 60  # a pixel shows the mirrored point
    fx, _, cx, _ = once["crop_camera"][0].tolist()
    before = (u - seen["crop_camera"][0, 2].item()) / fx
    assert (once["crop"].shape[-1] - 1 - u - cx) / fx == pytest.approx(-before, abs=1e-5)
    assert once["crop"][0, v, once["crop"].shape[-1] - 1 - u] == seen["crop"][0, v, u]


def test_a_second_look_in_the_mirror_replaces_a_bad_first_one(shipped):
    camera, images, _ = next(frames())
    frame = shipped.observe(images.depth, camera)
    seen = {
        name: torch.from_numpy(np.asarray(value))[None]
        for name, value in frame.detector.items()
        if name in MIRRORED
    }
    looks = []

    def detect(observations):
        looks.append(torch.equal(observations["crop"], seen["crop"]))
        return shipped.detector.module(observations)

    def regress(observations):
        rotmats, betas = (values[-1] for values in shipped.regressor.module(observations))
        return rotmats, betas

    with torch.inference_mode():
        right = shipped.detector.module(seen)
        wrong = right * torch.tensor([1.0, -1, 1])  # head down
        guess = regress({"initial_joints": wrong})
        alone, _ = refine(shipped.refiner, seen, wrong, guess, None, regress)
        fits, joints = refine(shipped.refiner, seen, wrong, guess, detect, regress)
        good, kept = refine(shipped.refiner, seen, right, regress({"initial_joints": right}), detect, regress)
    assert isinstance(fits, Refined)
    assert looks == [False]  # one look, at the mirror image; none where the first fit is good
    assert fits.misfit < 0.7 * alone.misfit
    assert (joints - right).norm(dim=-1).mean() < 0.1
    assert torch.equal(fits.residual_mm[:, 0], alone.residual_mm[:, 0])
    assert good.is_kept.all()
    assert torch.equal(kept, right)
