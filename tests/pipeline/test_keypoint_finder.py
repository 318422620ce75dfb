import numpy as np
import pytest
import torch

from ljn.cloud.observation import ObservationRecipe, observe
from ljn.cloud.rgb import RgbRecipe
from ljn.geometry.camera import transfer
from ljn.modules.keypoint_detector import KeypointDetector
from ljn.nets.cpn import SEES, CascadedPyramidNetwork, FoundKeypoints
from ljn.nets.resnet import ResNet
from ljn.pipeline.keypoint_finder import KeypointFinder
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.stages import Stage

LIGHT = {"block": "basic", "depths": (1, 1, 1, 1), "widths": (8, 8, 8, 8), "stem_channels": 8, "stem_px": 3}


def finder(sees="depth"):
    torch.manual_seed(0)
    net = CascadedPyramidNetwork(ResNet(3 if sees == "rgb" else 2, **LIGHT), sees, 8, 4)
    module = KeypointDetector(net).eval().requires_grad_(False)
    recipe = RgbRecipe(64, 64) if sees == "rgb" else ObservationRecipe(32, crop_px=64)
    return KeypointFinder(Stage(module, recipe, {"hash": "abc"}))


class Told(torch.nn.Module):
    """Finds, in any crop, what it was told."""

    def __init__(self, keypoints, confidences):
        super().__init__()
        self.sees, self.takes = "depth", SEES["depth"]
        self.found = FoundKeypoints(keypoints[None], confidences[None])

    def forward(self, image):
        assert image.shape == (1, 64, 64)
        return self.found


def test_found_keypoints_are_in_pixels_of_the_image_and_unsure_ones_do_not_count(given, kinect):
    depth, keypoints = given
    stage = finder().stage
    made = observe(depth, kinect, None, stage.recipe, ("crop", "crop_camera"), np.random.default_rng(0))
    in_crop = transfer(
        torch.from_numpy(keypoints), kinect.intrinsics(), torch.from_numpy(made["crop_camera"])
    )
    confidences = torch.full((24,), 0.9)
    confidences[5] = 0.1
    stage.module.net = Told(in_crop, confidences)
    found = KeypointFinder(stage)(depth, kinect)
    np.testing.assert_allclose(found.positions, keypoints, atol=1e-3)
    assert found.confidences[5] == 0
    assert (np.delete(found.confidences, 5) == np.float32(0.9)).all()


def test_a_pipeline_finds_keypoints_where_none_are_given_and_given_ones_lead(stages, given, kinect):
    depth, keypoints = given
    pipeline = Pipeline(*stages, finder=finder())
    assert not pipeline.needs_keypoints
    found = pipeline(depth, kinect)
    expected = pipeline.finder(depth, kinect)
    np.testing.assert_allclose(
        found.keypoints, expected.positions.clip(0, [kinect.width - 1, kinect.height - 1])
    )
    assert found.report.facts["keypoints_found_in"] == "depth"
    assert found.report.facts["keypoints_unsure"] == (expected.confidences == 0).sum()
    given_ones = pipeline(depth, kinect, keypoints)
    np.testing.assert_array_equal(given_ones.joints, Pipeline(*stages)(depth, kinect, keypoints).joints)
    assert "keypoints_found_in" not in given_ones.report.facts


def test_colours_are_cropped_around_the_person_and_have_to_fit_the_depth_image(stages, given, kinect):
    depth, _ = given
    pipeline = Pipeline(*stages, finder=finder("rgb"))
    rgb = np.random.default_rng(0).integers(0, 256, (kinect.height, kinect.width, 3), dtype=np.uint8)
    found = pipeline(depth, kinect, rgb=rgb)
    assert found.report.facts["keypoints_found_in"] == "rgb"
    # What is not the person plays no part, nor does an alpha channel.
    others = np.dstack([np.where((depth > 0)[..., None], rgb, 255 - rgb), np.full(depth.shape, 7, np.uint8)])
    np.testing.assert_array_equal(pipeline(depth, kinect, rgb=others).joints, found.joints)
    batch = pipeline(np.stack([depth, depth]), kinect, rgb=[rgb, rgb])
    np.testing.assert_allclose(batch.joints[1], found.joints, atol=1e-5)
    with pytest.raises(ValueError, match=r"rgb: expected uint8 of shape \(512, 424, 3\).*got none"):
        pipeline(depth, kinect)
    for wrong in (rgb[::2], rgb.astype(float), rgb[..., 0]):
        with pytest.raises(
            ValueError, match=r"rgb: expected uint8 of shape \(512, 424, 3\).*got .* of shape"
        ):
            pipeline(depth, kinect, rgb=wrong)
