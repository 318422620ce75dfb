from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.scenes import KeptScenes, Scene, mirrored, mirrored_pose
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SMPL, SparseSMPL, load_body_models
from ljn.body.skeleton import MIRROR, ROOT
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import project
from ljn.geometry.rotations import body_to_camera, rotvec_to_rotmat
from ljn.render import get_renderer

ACROSS = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
RENDERED = [(0, index) for index in range(8)]
AGAIN = [(*key, 1) for key in RENDERED]  # every one mirrored


@pytest.fixture(scope="module")
def make(body_models, source, kinect):
    """Builds a synthesizer of eight embedded records, float64."""
    records = source.records("val", 8, seed=2)
    layer = SparseSMPL(body_models).double()

    def build(takes=("points", "crop", "crop_camera"), num_kept=0, dtype=torch.float64, **changes):
        settings, recipe = SynthesisSettings(**changes), ObservationRecipe(64)
        given = (records, body_models, kinect, settings, recipe, takes, (0, 0), dtype, num_kept)
        synthesizer = DepthSynthesizer(*given)
        if dtype == torch.float64:
            synthesizer.__dict__["_smpl"] = layer
        return synthesizer

    return build


@pytest.fixture(scope="module")
def scene(make):
    return make()._render(RENDERED, with_depth=True)


@pytest.fixture(scope="module")
def again(make):
    return make(keypoint_noise_px=0.0).batch(AGAIN)


def copy_of(scene):
    return scene._replace(depth=[image.copy() for image in scene.depth])


def meshes(body_models, pose, betas, gender, joints):
    """Vertices `(B, V, 3)` in the camera frame, of bodies in a pose whose root is where the joints say."""
    output = SMPL(body_models).double()(pose.double(), betas.double(), gender)
    vertices, posed = map(body_to_camera, output)
    return vertices + (joints.double() - posed)[:, ROOT, None]


# Mirror images


@pytest.mark.parametrize("gender", ["female", "male", "neutral"])
def test_a_body_in_the_mirrored_pose_is_the_mirrored_body(scene, gender):
    (model,) = load_body_models(None, [gender])
    layer = SMPL(model).double()
    sides = model.v_template.astype(np.float64)
    partner = torch.cdist(torch.tensor(sides), torch.tensor(sides) * ACROSS).argmin(1)
    in_world = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    plain, turned = (layer(pose, scene.betas) for pose in (scene.pose, mirrored_pose(scene.pose)))
    for name, counterpart in (("joints", list(MIRROR)), ("vertices", partner)):
        # The root itself stays where it is at rest, in any pose.
        one, other = (getattr(body, name) - body.joints[:, ROOT, None] for body in (plain, turned))
        torch.testing.assert_close(other, one[:, counterpart] * in_world, atol=1e-6, rtol=0)
    assert (turned.joints - plain.joints).abs().max() > 0.1


def test_a_mirror_image_of_a_mirror_image_is_the_pose(scene):
    rotmats = [
        rotvec_to_rotmat(p.unflatten(-1, (24, 3)))
        for p in (scene.pose, mirrored_pose(mirrored_pose(scene.pose)))
    ]
    torch.testing.assert_close(*rotmats, atol=1e-9, rtol=0)


def test_a_mirrored_image_is_that_of_the_mirrored_body(scene, body_models):
    turned = mirrored(copy_of(scene), [True] * 8)
    assert all(np.array_equal(one, other[:, ::-1]) for one, other in zip(turned.depth, scene.depth))
    vertices = meshes(body_models, turned.pose, turned.betas, turned.gender, turned.joints)
    depth = get_renderer("zbuffer")(vertices, SMPL(body_models).faces, turned.cameras[0]).numpy()
    found = np.stack(turned.depth)
    both = (depth > 0) & (found > 0)
    assert ((depth > 0) != (found > 0)).sum() <= 8, "pixels on the silhouette, by rounding"
    assert both.sum() > 50_000
    assert np.abs(depth - found)[both].max() < 1e-4


def test_bodies_are_mirrored_one_by_one(scene):
    which = [True, False] * 4
    some, all_ = mirrored(copy_of(scene), which), mirrored(copy_of(scene), [True] * 8)
    for name in ("pose", "joints", "depth"):
        parts = [torch.as_tensor(np.stack(getattr(each, name))) for each in (scene, some, all_)]
        assert torch.equal(parts[1][1::2], parts[0][1::2]), name
        assert torch.equal(parts[1][::2], parts[2][::2]), name
    camera = scene.cameras[0]
    assert some.cameras == [replace(camera, cx=camera.width - 1 - camera.cx), camera] * 4
    assert mirrored(scene, [False] * 8) is scene


# Samples of mirrored renders


def test_every_second_use_is_mirrored_and_draws_are_its_own(make):
    uses = [make(keypoint_noise_px=10.0).batch([(*key, use) for key in RENDERED]) for use in range(4)]
    first = make().batch(RENDERED)
    assert all(torch.equal(uses[0][name], first[name]) for name in first)
    for use in (1, 3):
        torch.testing.assert_close(uses[use]["joints"], first["joints"][:, list(MIRROR)] * ACROSS.float())
    torch.testing.assert_close(uses[2]["joints"], first["joints"])
    for name in ("points", "keypoints", "initial_joints", "crop"):
        for one, other in ((0, 1), (0, 2), (1, 3)):
            assert (uses[one][name] != uses[other][name]).flatten(1).any(1).all(), name
    noises = torch.stack([use["keypoints"] - use["true_keypoints"] for use in uses])
    assert torch.pdist(noises.flatten(1)).min() > 100


def test_a_mirrored_sample_agrees_with_itself(again, make, body_models):
    plain = make(keypoint_noise_px=0.0).batch(RENDERED)
    for points, pixels in (("joints", "true_keypoints"), ("initial_joints", "keypoints")):
        torch.testing.assert_close(project(again[points], again["camera"]), again[pixels], atol=1e-3, rtol=0)
    # True keypoints lifted lie before their joints, as far as those of the render lie.
    far = [(batch["initial_joints"] - batch["joints"]).norm(dim=-1) for batch in (plain, again)]
    torch.testing.assert_close(far[1], far[0][:, list(MIRROR)], atol=0.02, rtol=0)
    vertices = meshes(body_models, again["pose"], again["betas"], again["gender"], again["joints"])
    for mesh, points in zip(vertices, again["points"]):
        assert torch.cdist(points[:, :3].double(), mesh).amin(1).max() < 0.04
    v, u = (again["crop"][0] > 0).nonzero().unbind(1)
    depth = again["crop"][0][v, u]
    fx, fy, cx, cy = again["crop_camera"][0]
    seen = torch.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], -1).double()
    assert torch.cdist(seen, vertices[0]).amin(1).max() < 0.04


def test_a_mirrored_sample_without_an_image_is_that_with_one(make):
    blind, seen = (make(takes, initial_joints="noised").batch(AGAIN) for takes in ((), ("points",)))
    assert all(torch.equal(blind[name], seen[name]) for name in blind)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_kept_render_gives_the_samples_of_a_new_one(make, dtype):
    keeping, plain = (make(num_kept=number, dtype=dtype) for number in (1, 0))
    for use in (0, 1, 2):
        keys = [(*key, use) for key in RENDERED]
        one, other = keeping.batch(keys), plain.batch(keys)
        assert all(torch.equal(one[name], other[name]) for name in one)
    assert len(keeping._kept._scenes) == 1


# Keeping them


def tiny(value):
    depth = np.zeros((4, 5), np.float32)
    depth[1:3, 2:4] = value
    return Scene(torch.zeros(1, 72), torch.zeros(1, 10), torch.zeros(1), torch.zeros(1, 24, 3), [], [depth])


def test_a_kept_scene_is_mirrored_as_a_new_one(scene):
    kept = KeptScenes(1)
    kept.put("key", scene)
    which = [True, False, False, True] * 2
    found, expected = kept.get("key", which), mirrored(copy_of(scene), which)
    for one, other in zip(found, expected):
        assert np.array_equal(one, other) if isinstance(one, torch.Tensor) else len(one) == len(other)
    assert found.cameras == expected.cameras
    assert all(np.array_equal(one, other) for one, other in zip(found.depth, expected.depth))


def test_the_scene_used_least_recently_is_forgotten():
    kept = KeptScenes(2)
    for value in (1, 2):
        kept.put(value, tiny(value))
    kept.get(1, [False]).depth[0][:] = 9  # whoever gets one may change it
    kept.put(3, tiny(3))
    assert kept.get(2, [False]) is None
    for value in (1, 3):
        assert np.array_equal(kept.get(value, [False]).depth[0], tiny(value).depth[0])


def test_scenes_without_an_image_or_a_body_in_it_are_kept_as_they_are():
    for depth in (np.zeros((0, 0), np.float32), np.zeros((4, 5), np.float32)):
        kept = KeptScenes(1)
        kept.put("key", tiny(1)._replace(depth=[depth]))
        assert np.array_equal(kept.get("key", [True]).depth[0], depth)


def test_nothing_is_kept_where_nothing_is_asked_for():
    kept = KeptScenes(0)
    kept.put(1, tiny(1))
    assert kept.get(1, [False]) is None
