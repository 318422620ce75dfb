import itertools
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix

from ljn.body import SMPL, load_body_model
from ljn.body.skeleton import PARENTS, ROOT
from ljn.cloud.observation import ObservationRecipe, observe
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.modules.joint_detector import JointDetector
from ljn.nets.cascade import PatchCascade
from ljn.pipeline.keypoints import smpl_keypoints
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.report import Report
from ljn.render import get_renderer


def arrays(prediction):
    return prediction.arrays


def assert_equal(first, second, atol=0.0):
    assert arrays(first).keys() == arrays(second).keys()
    for name, value in arrays(first).items():
        np.testing.assert_allclose(value, arrays(second)[name], rtol=0, atol=atol, err_msg=name)


def test_it_observes_as_training_does_and_predicts_what_evaluation_does(
    samples, stages, pipeline, kinect, monkeypatch
):
    for index, (batch, depth) in enumerate(samples):
        # The stream that the sample's own points were drawn from: seed, split, epoch, index, purpose.
        monkeypatch.setattr("ljn.pipeline.pipeline._SEED", [7, 0, 0, index, 2])
        keypoints = batch["keypoints"][0].numpy()
        frame = pipeline.observe(depth, kinect, keypoints)
        for observation in (frame.detector, frame.regressor):
            for name, value in observation.items():
                np.testing.assert_array_equal(value, batch[name][0], err_msg=name)
        prediction = pipeline(depth, kinect, keypoints)
        np.testing.assert_array_equal(prediction.points, batch["points"][0])
        detector, regressor = (stage.module for stage in stages)
        joints = detector.evaluate(batch, detector.test_metrics)["pred_joints"]
        np.testing.assert_array_equal(prediction.joints, joints[0])
        expected = regressor.evaluate({**batch, "initial_joints": joints}, regressor.test_metrics)
        np.testing.assert_array_equal(prediction.vertices, expected["pred_vertices"][0])
        np.testing.assert_array_equal(prediction.pose, expected["pred_pose"][0])
        np.testing.assert_array_equal(prediction.betas, expected["pred_betas"][0])


def test_the_mesh_of_pose_and_shape_is_placed_at_the_detected_root(pipeline, given, kinect):
    found = pipeline(given[0], kinect, given[1])
    body = SMPL.load()
    vertices, joints = body(torch.from_numpy(found.pose), torch.from_numpy(found.betas))
    turned = (vertices - joints[ROOT]) @ CAMERA_FROM_BODY.float().T
    np.testing.assert_allclose(
        found.vertices, (turned + torch.from_numpy(found.joints[ROOT])).numpy(), atol=1e-5
    )
    np.testing.assert_array_equal(found.faces, body.faces)


def test_any_smpl_layer_gives_the_same_vertices_in_the_camera_frame(pipeline, given, kinect, tmp_path):
    smplx = pytest.importorskip("smplx", reason="smplx is not installed")
    body = load_body_model()
    fields = {name: getattr(body, name) for name in ("v_template", "shapedirs", "posedirs", "weights")}
    fields["J_regressor"] = csc_matrix(body.J_regressor)
    fields["kintree_table"] = np.array([[2**32 - 1, *PARENTS[1:]], range(24)])
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(fields | {"f": body.faces.astype(np.uint32)}))
    found = pipeline(given[0], kinect, given[1])
    layer = smplx.SMPL(str(tmp_path / "body.pkl"), dtype=torch.float32)
    names = {"betas": found.betas, "global_orient": found.global_orient, "transl": found.transl}
    names["body_pose"] = found.pose[3:]
    posed = layer(**{name: torch.from_numpy(value)[None] for name, value in names.items()})
    np.testing.assert_allclose(posed.vertices[0].detach(), found.vertices, atol=1e-5)
    np.testing.assert_allclose(posed.joints[0, :24].detach(), found.mesh_joints, atol=1e-5)


def test_a_doubt_is_logged_and_reported_and_with_strict_an_error(stages, given, kinect, caplog):
    aside = replace(kinect, cx=60.0)
    found = Pipeline(*stages)(given[0], aside, given[1])
    assert "far from the middle" in found.report.warnings[0]
    assert "far from the middle" in caplog.text
    assert found.report.facts["pixels"] > 1000
    with pytest.raises(ValueError, match=r"far from the middle.*strict=true"):
        Pipeline(*stages, strict=True)(given[0], aside, given[1])


def test_a_batch_gives_what_its_images_give_alone(pipeline, samples, kinect):
    depth = np.stack([image for _, image in samples])
    keypoints = [batch["keypoints"][0].numpy() for batch, _ in samples]
    together = pipeline(depth, kinect, keypoints)
    assert together.vertices.shape == (3, 6890, 3)
    for index in range(3):
        assert_equal(together[index], pipeline(depth[index], kinect, keypoints[index]), atol=2e-6)


def test_the_same_input_gives_the_same_output_whatever_was_drawn_before(pipeline, given, kinect):
    first = pipeline(given[0], kinect, given[1])
    torch.manual_seed(99)
    np.random.default_rng().standard_normal(5)
    assert_equal(pipeline(given[0], kinect, given[1]), first)


def test_integer_millimetres_equal_metres(pipeline, given, kinect):
    millimetres = (1000 * given[0]).round().astype(np.uint16)
    assert_equal(pipeline(millimetres, kinect, given[1]), pipeline(millimetres / 1000, kinect, given[1]))


def test_a_mask_equals_an_image_without_background(pipeline, given, kinect):
    depth, keypoints = given
    behind = np.where(depth > 0, depth, np.float32(4))
    assert_equal(
        pipeline(behind, kinect, keypoints, mask=255 * (depth > 0).astype(np.uint8)),
        pipeline(depth, kinect, keypoints),
    )


def test_without_a_regressor_there_are_joints_alone(stages, given, kinect):
    found = Pipeline(stages[0])(given[0], kinect, given[1])
    assert found.joints.shape == (24, 3)
    assert found.vertices is None
    assert found.faces is None


def test_each_stage_gets_the_cloud_of_its_own_training(stages, given, kinect):
    other = stages[1]._replace(recipe=ObservationRecipe(64, "knn", spacing_m=stages[1].recipe.spacing_m))
    frame = Pipeline(stages[0], other).observe(given[0], kinect, given[1])
    points, mesh_points = frame.detector["points"], frame.regressor["points"]
    assert points.shape == (128, 6)
    assert mesh_points.shape == (64, 6)
    np.testing.assert_array_equal(points[:64, :3], mesh_points[:, :3])
    assert not np.array_equal(points[:64, 3:], mesh_points[:, 3:])


def test_a_lying_camera_of_another_size_sees_the_same_person(pipeline, samples):
    # The same body, rendered by a camera of other intrinsics and size: clouds of the same surface.
    camera = Camera(fx=210.0, fy=212.0, cx=130.0, cy=90.0, width=256, height=192)
    body = SMPL.load()
    vertices, joints = body(torch.zeros(72), torch.zeros(10))
    upright = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # SMPL's rest frame to camera axes
    place = torch.tensor([0.0, 0, 2.5])
    vertices, joints = ((x - joints[ROOT]) @ upright.T + place for x in (vertices, joints))
    depth = get_renderer("zbuffer")(vertices[None], body.faces, camera)[0].numpy()
    keypoints = project(joints, camera.intrinsics()).numpy()
    found = pipeline(depth, camera, keypoints)
    assert np.abs(found.initial_joints[:, :2] - joints[:, :2].numpy()).max() < 0.15
    assert found.points[:, 2].min() > 2.2
    assert abs(found.points[:, 1].mean() - float(joints[:, 1].mean())) < 0.2


def test_pixels_much_denser_than_in_training_are_thinned_to_patches_of_the_same_size(kinect):
    step = 3
    camera = Camera(**{name: step * value for name, value in vars(kinect).items()})
    # A tilted plane 1.4 m away, seen by both cameras: z = 1.4 + 0.3 x.
    images = []
    for one in (kinect, camera):
        v, u = np.mgrid[: one.height, : one.width]
        x = (u - one.cx) / one.fx
        depth = 1.4 / (1 - 0.3 * x)
        inside = (abs(x) < 0.13) & (abs(v - one.cy) < 0.13 * one.fy)
        images.append(np.where(inside, depth, 0).astype(np.float32))
    recipe = ObservationRecipe(256, spacing_m=1.5 / kinect.fx)
    coarse, fine = (
        observe(image, one, None, recipe, ("points",), np.random.default_rng(0))["points"]
        for image, one in zip(images, (kinect, camera))
    )
    # The fine camera's every third pixel is the coarse camera's image.
    np.testing.assert_allclose(fine, coarse, atol=2e-3)
    np.testing.assert_allclose(fine[:, 3:] @ np.array([0.3, 0, -1]) / np.hypot(0.3, 1), 1, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d, k: (1000 * d, k), "depth: floats are metres, but the median is .*millimetres"),
        (lambda d, k: (d.round().astype(np.uint16), k), "depth: integers are millimetres, but the median is"),
        (lambda d, k: (d.T, k), "depth: expected the camera's 512 x 424.*transposed, or the camera's width"),
        (lambda d, k: (d[:100], k), "depth: expected the camera's 512 x 424.*got 100 x 424.*scale its fx"),
        (lambda d, k: (0 * d, k), "depth: all pixels are 0"),
        (lambda d, k: (np.full_like(d, np.nan), k), r"no depth \(217088 are negative, NaN"),
        (lambda d, k: (-d, k), r"no depth \(\d+ are negative, NaN"),
        (lambda d, k: (d > 0, k), "depth: expected float metres or integer millimetres, got bool"),
        (lambda d, k: (np.full_like(d, 2), k), "no person was found.*give a mask of the person"),
        (lambda d, k: (0.1 * d, k), "less than a person; is the depth in another unit"),
        (lambda d, k: (d, k + 300), r"keypoints: as smpl24 they do not fit .*shifted by \(-\d+, -\d+\) pixels"),
        (lambda d, k: (d, k / [424, 512]), "expected pixels, but all lie between 0 and 2.*multiply"),
        (lambda d, k: (d, k[:20]), "keypoints: expected 24 .smpl24., 17 .coco17., .* of them, got 20 .a Kinect v1's"),
        (lambda d, k: (d, k * [0.2, 0.2]), "do not fit the body .*multiplied by"),
        (lambda d, k: (d, np.where(np.arange(24)[:, None] < 7, k, np.nan)), "7 joints are known, expected at least 8"),
    ],
)  # fmt: skip
def test_bad_input_is_an_error_that_says_how_to_mend_it(change, message, pipeline, given, kinect):
    depth, keypoints = change(*given)
    with pytest.raises(ValueError, match=f"(?s){message}"):
        pipeline(depth, kinect, keypoints)


def test_what_the_keypoints_were_is_reported(pipeline, given, kinect):
    depth, keypoints = given
    keypoints[20] = [15, 20]
    report = Report()
    frame = pipeline.observe(depth, kinect, keypoints, report=report)
    assert report.facts["keypoint_order"] == "smpl24"
    assert report.facts["keypoints_mistrusted"] == ["l_wrist"]
    assert frame.confidences[20] == 0
    with pytest.raises(ValueError, match=r"keypoints: l_wrist lie far .*strict=true"):
        pipeline.observe(depth, kinect, keypoints, report=Report(is_strict=True))


def test_a_bad_mask_is_an_error(pipeline, given, kinect):
    depth, keypoints = given
    with pytest.raises(ValueError, match=r"mask: expected the camera's 512 x 424.*transposed"):
        pipeline(depth, kinect, keypoints, mask=depth.T > 0)
    with pytest.raises(ValueError, match="mask: no pixel of the mask has a depth"):
        pipeline(depth, kinect, keypoints, mask=depth == 0)


def test_an_error_in_a_batch_names_the_image(pipeline, given, kinect):
    depth, keypoints = given
    with pytest.raises(ValueError, match="image 1 of the batch: depth: all pixels are 0"):
        pipeline(np.stack([depth, 0 * depth]), kinect, [keypoints, keypoints])
    with pytest.raises(ValueError, match=re.escape("got 2 images, 1 keypoints, 2 masks and 2 colour images")):
        pipeline(np.stack([depth, depth]), kinect, [keypoints])


def test_a_detector_that_can_do_without_takes_all_keypoints_some_or_none(stages, given, kinect):
    torch.manual_seed(0)
    detector = JointDetector(PatchCascade(patch_sizes_m=(0.5,))).eval().requires_grad_(False)
    pipeline = Pipeline(stages[0]._replace(module=detector))
    depth, keypoints = np.stack([given[0]] * 2), given[1]
    without = pipeline(depth, kinect)
    assert without.joints.shape == (2, 24, 3)
    assert without.keypoints is None
    some = np.where(np.arange(24)[:, None] < 3, keypoints, np.nan)
    found = [pipeline(depth[0], kinect, each) for each in (keypoints, some)]
    assert [np.count_nonzero(each.confidences) for each in found] == [24, 3]
    joints = [without.joints[0], *(each.joints for each in found)]
    assert min(np.abs(a - b).max() for a, b in itertools.combinations(joints, 2)) > 0.01
    with pytest.raises(ValueError, match="keypoints: some images of the batch have them"):
        pipeline(depth, kinect, [None, keypoints])


def test_given_joints_stand_in_place_of_the_detectors(pipeline, given, kinect):
    depth, keypoints = given
    frame = pipeline.observe(depth, kinect, keypoints)
    found = pipeline.predict([frame])
    again = pipeline.predict([frame], found.joints)
    np.testing.assert_array_equal(again.vertices, found.vertices)
    moved = pipeline.predict([frame], found.joints + np.float32(0.1))
    np.testing.assert_allclose(moved.mesh_joints[:, 0], found.mesh_joints[:, 0] + 0.1, atol=1e-5)
    np.testing.assert_array_equal(moved.joints, found.joints + np.float32(0.1))


def test_a_cloud_of_another_number_of_points_can_be_asked_for(pipeline, given, kinect):
    depth, keypoints = given
    named = smpl_keypoints(keypoints)
    same, fewer = (pipeline.observe_body(depth, kinect, named, number) for number in (None, 64))
    expected = pipeline.observe(depth, kinect, keypoints)
    np.testing.assert_array_equal(same.detector["points"], expected.detector["points"])
    assert fewer.detector["points"].shape == fewer.regressor["points"].shape == (64, 6)
