import math
import os
import pickle
import resource

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from datamodules.noise import add_keypoint_noise
from datamodules.sources import PoseRecords
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings, concatenate
from ljn.body import SMPL, SparseSMPL
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.cloud.observation import ObservationRecipe
from ljn.data import Batch
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import (
    CAMERA_FROM_BODY,
    rotation_about,
    rotmat_to_rotvec,
    rotvec_to_rotmat,
    smpl_pose_to_body_world,
)

KEYS = [(0, index) for index in range(12)]
# What no random draw after the placement touches.
TRUTH = ("true_keypoints", "joints", "pose", "betas", "gender", "camera", "sample_id")


@pytest.fixture(scope="module")
def make(body_models, source, kinect):
    """Builds a synthesizer of twelve embedded records; float64, as for the fixed sets, unless told otherwise."""
    records = source.records("val", 12, seed=2)
    layers = {dtype: SparseSMPL(body_models).to(dtype) for dtype in (torch.float32, torch.float64)}

    def build(
        seed_key=(0, 0), dtype=torch.float64, records=records, camera=kinect, num_points=64,
        takes=("points",), **changes,
    ):  # fmt: skip
        settings, recipe = SynthesisSettings(**changes), ObservationRecipe(num_points)
        synthesizer = DepthSynthesizer(records, body_models, camera, settings, recipe, takes, seed_key, dtype)
        synthesizer.__dict__["_smpl"] = layers[dtype]  # building it would take longer than all the rest
        return synthesizer

    return build


@pytest.fixture(scope="module")
def batch(make):
    return make().batch(KEYS)


def upright_records(heading):
    """One T-pose that faces along +x, turned by `heading` radians about the vertical."""
    pose = smpl_pose_to_body_world(torch.zeros(72, dtype=torch.float64))
    turn = rotation_about("z", torch.tensor(heading, dtype=torch.float64))
    root = rotmat_to_rotvec(turn @ rotvec_to_rotmat(pose[:3]))
    return PoseRecords(
        pose=torch.cat([root, pose[3:]])[None].float().numpy(),
        betas=np.zeros((1, 10), np.float32),
        gender=np.zeros(1, np.int64),
        sequence=np.array(["still"]),
        frame=np.zeros(1, np.int64),
        has_heading=True,
    )


def meshes(body_models, batch):
    """Vertices `(B, V, 3)` in the camera frame, from the batch alone (Eq. 3.4)."""
    output = SMPL(body_models).double()(batch["pose"].double(), batch["betas"].double(), batch["gender"])
    vertices, joints = (points @ CAMERA_FROM_BODY.T for points in output)
    return vertices + (batch["joints"].double() - joints)[:, ROOT, None]


# The contract


def test_a_batch_keeps_its_contract(batch):
    shapes = {
        "points": (12, 64, 6), "true_keypoints": (12, 24, 2), "keypoints": (12, 24, 2), "initial_joints": (12, 24, 3),
        "joints": (12, 24, 3), "pose": (12, 72), "betas": (12, 10), "gender": (12,), "camera": (12, 4),
        "sample_id": (12,),
    }  # fmt: skip
    others = {"crop", "crop_camera", "rgb", "rgb_camera", "confidences", "lifted_joints"}
    assert set(batch) == set(Batch.__annotations__) - others == set(shapes)
    for name, shape in shapes.items():
        assert batch[name].shape == shape, name
        assert batch[name].dtype == (torch.int64 if name in ("gender", "sample_id") else torch.float32), name
        assert batch[name].isfinite().all(), name
    assert batch["sample_id"].tolist() == list(range(12))


# Determinism


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_keys_give_the_same_bits(make, dtype):
    first, again = make(dtype=dtype).batch(KEYS), make(dtype=dtype).batch(KEYS)
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_a_sample_is_the_same_alone_in_another_order_and_in_another_batch(make, batch):
    # In float64; in float32 a pixel on the silhouette may flip with the rounding of the body's products, and
    # every draw after it moves on by one.
    synthesizer = make()
    for keys in ([KEYS[4]], KEYS[::-1], [KEYS[7], KEYS[7], KEYS[4]]):
        other = synthesizer.batch(keys)
        rows = [index for _, index in keys]
        for name in batch:
            torch.testing.assert_close(other[name], batch[name][rows], atol=1e-5, rtol=0)


def test_float32_gives_the_same_bodies_as_float64(make, batch):
    single = make(dtype=torch.float32).batch(KEYS)
    torch.testing.assert_close(single["joints"], batch["joints"], atol=1e-5, rtol=0)
    torch.testing.assert_close(single["pose"], batch["pose"], atol=1e-5, rtol=0)
    torch.testing.assert_close(single["keypoints"], batch["keypoints"], atol=1e-2, rtol=0)


@pytest.mark.parametrize(("seed_key", "epoch"), [((0, 0), 1), ((1, 0), 0), ((0, 1), 0)])
def test_another_seed_split_or_epoch_draws_everything_anew(make, batch, seed_key, epoch):
    other = make(seed_key).batch([(epoch, index) for _, index in KEYS])
    for name in ("points", "keypoints", "joints"):
        assert (other[name] != batch[name]).flatten(1).any(1).all(), name
    noises = [b["keypoints"] - b["true_keypoints"] for b in (batch, other)]
    assert (noises[0] - noises[1]).abs().mean() > 5
    # The records' own pose and shape stay; only the heading is drawn.
    assert torch.equal(other["betas"], batch["betas"])
    torch.testing.assert_close(other["pose"][:, 3:], batch["pose"][:, 3:])
    assert (other["pose"][:, :3] != batch["pose"][:, :3]).any()


def test_fewer_points_are_the_first_ones_and_leave_everything_else(make, batch):
    fewer = make(num_points=20).batch(KEYS)
    assert torch.equal(fewer["points"], batch["points"][:, :20])
    for name in set(batch) - {"points"}:
        assert torch.equal(fewer[name], batch[name]), name


@pytest.mark.parametrize("noise_px", [0.0, 15.0])
def test_the_keypoints_noise_leaves_everything_else(make, batch, noise_px):
    other = make(keypoint_noise_px=noise_px).batch(KEYS)
    for name in (*TRUTH, "points"):
        assert torch.equal(other[name], batch[name]), name
    assert not torch.equal(other["keypoints"], batch["keypoints"])
    assert torch.equal(other["keypoints"], other["true_keypoints"]) == (noise_px == 0)


def test_the_depth_noise_leaves_keypoints_places_and_the_choice_of_pixels(make, batch):
    clean = make(depth_noise_m=0.0).batch(KEYS)
    for name in (*TRUTH, "keypoints"):
        assert torch.equal(clean[name], batch[name]), name
    pixels = [project(b["points"][..., :3], b["camera"]) for b in (clean, batch)]
    torch.testing.assert_close(*pixels, atol=1e-3, rtol=0)
    noise = batch["points"][..., 2] - clean["points"][..., 2]
    assert float(noise.std()) == pytest.approx(0.001, rel=0.1)


def test_joints_with_noise_need_no_image_and_are_the_same_as_with_one(make):
    seen = make(initial_joints="noised").batch(KEYS)
    blind = make(initial_joints="noised", takes=())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(blind.__dict__, "_renderer", None)
        unseen = blind.batch(KEYS)
    assert set(unseen) == set(seen) - {"points"}
    assert all(torch.equal(unseen[name], seen[name]) for name in unseen)
    assert not torch.equal(unseen["initial_joints"], unseen["joints"])
    examples, depth = blind.examples(KEYS[:2])  # these show what is not taken
    assert (depth > 0).flatten(1).any(1).all()
    torch.testing.assert_close(examples["initial_joints"], unseen["initial_joints"][:2], atol=1e-5, rtol=0)


def test_a_synthesizer_survives_its_way_to_another_process(make, batch):
    synthesizer = make()
    synthesizer.batch(KEYS[:1])
    content = pickle.dumps(synthesizer)
    other = pickle.loads(content).batch(KEYS)
    assert all(torch.equal(other[name], batch[name]) for name in batch)
    assert len(content) < 1.2 * len(pickle.dumps(make())), "what is made on first use stays at home"


# Geometry


@pytest.mark.parametrize(
    ("joints", "keypoints"), [("joints", "true_keypoints"), ("initial_joints", "keypoints")]
)
def test_joints_project_onto_their_keypoints(joints, keypoints, batch):
    projected = project(batch[joints], batch["camera"])
    torch.testing.assert_close(projected, batch[keypoints], atol=1e-3, rtol=0)


def test_initial_joints_lie_at_a_depth_of_the_body(batch, body_models):
    depth, vertices = batch["initial_joints"][..., 2], meshes(body_models, batch)[..., 2]
    assert (depth > vertices.amin(1, keepdim=True) - 0.01).all()
    assert (depth < vertices.amax(1, keepdim=True) + 0.01).all()


def test_points_lie_on_the_mesh_that_pose_shape_and_joints_describe(batch, body_models):
    vertices = meshes(body_models, batch)
    for mesh, points in zip(vertices, batch["points"]):
        assert torch.cdist(points[:, :3].double(), mesh).amin(1).max() < 0.04


def test_points_are_seen_from_the_camera(batch):
    points, normals = batch["points"].split(3, -1)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(12, 64))
    assert ((points * normals).sum(-1) <= 1e-6).all()


def test_a_body_that_faces_the_camera_stands_the_right_way_round(make):
    settings = {"heading": "source", "num_points": 4000, "depth_noise_m": 0.0}
    facing = make(records=upright_records(0.0), **settings).batch([(0, 0)])
    joint = {name: facing["joints"][0, index].tolist() for name, index in JOINT_INDEX.items()}
    assert joint["l_shoulder"][0] > joint["r_shoulder"][0] + 0.2, "its left is at the image's right"
    assert joint["head"][1] < joint["pelvis"][1] < joint["l_ankle"][1], "y points down"
    for side in "lr":
        assert joint[f"{side}_foot"][2] < joint[f"{side}_ankle"][2] - 0.05, "its toes point to the camera"
    # The nose: the nearest point of the head lies in front of the head's joint, not behind.
    cloud = facing["points"][0, :, :3]
    head = cloud[cloud[:, 1] < joint["neck"][1] - 0.05]
    assert head[:, 2].min() < joint["head"][2]


@pytest.mark.parametrize(
    ("heading", "axis", "sign"), [(math.pi, 2, 1), (math.pi / 2, 0, 1), (-math.pi / 2, 0, -1)]
)
def test_a_turned_body_points_its_toes_where_its_heading_says(make, heading, axis, sign):
    turned = make(records=upright_records(heading), heading="source").batch([(0, 0)])["joints"][0]
    toes = turned[JOINT_INDEX["l_foot"]] - turned[JOINT_INDEX["l_ankle"]]
    assert sign * float(toes[axis]) > 0.1


def test_another_camera_sees_the_same_bodies(make, batch, kinect):
    half = Camera(kinect.fx / 2, kinect.fy / 2, kinect.cx / 2, kinect.cy / 2, 212, 256)
    small = make(camera=half, margin_px=4).batch(KEYS)
    assert small["true_keypoints"].min() >= 0
    assert (small["true_keypoints"] <= torch.tensor([211.0, 255.0])).all()
    torch.testing.assert_close(small["camera"][0], half.intrinsics())
    # Nearly the same field of view, so nearly the same place.
    torch.testing.assert_close(small["joints"], batch["joints"], atol=0.05, rtol=0)


# Keypoint noise


@pytest.mark.parametrize("noise_px", [5.0, 10.0, 15.0])
def test_the_mean_distance_of_noisy_keypoints_is_that_of_a_plane_gaussian(noise_px):
    keypoints = np.zeros((100_000, 2), np.float32)
    noisy = add_keypoint_noise(keypoints, noise_px, np.random.default_rng(0))
    assert noisy.dtype == np.float32
    mean = np.linalg.norm(noisy, axis=-1).mean()
    assert mean == pytest.approx(noise_px * math.sqrt(math.pi / 2), rel=0.01)


def test_a_sweep_over_sigma_shares_its_draws_through_the_whole_synthesis(make, kinect):
    fives, tens = (make(keypoint_noise_px=sigma).batch(KEYS) for sigma in (5.0, 10.0))
    limit = torch.tensor([kinect.width - 1.0, kinect.height - 1.0])
    inside = (tens["keypoints"] > 0) & (tens["keypoints"] < limit)
    assert inside.float().mean() > 0.95
    noises = [(b["keypoints"] - b["true_keypoints"])[inside] for b in (fives, tens)]
    torch.testing.assert_close(2 * noises[0], noises[1], atol=1e-3, rtol=0)


def test_noisy_keypoints_are_clipped_to_the_image(make, kinect):
    noisy = make(keypoint_noise_px=200.0).batch(KEYS)["keypoints"]
    assert noisy.min() == 0
    assert noisy.amax((0, 1)).tolist() == [kinect.width - 1, kinect.height - 1]


# Joining batches


def test_joined_batches_equal_one(make, batch):
    parts = [make().batch(KEYS[:5]), make().batch(KEYS[5:])]
    joined = concatenate(iter(parts), 12)
    assert list(joined) == list(parts[0])
    for name in batch:
        torch.testing.assert_close(joined[name], batch[name], atol=1e-5, rtol=0)


class _Numbers(torch.utils.data.Dataset):
    def __getitem__(self, index):
        return {"sample_id": torch.tensor(index), **{f"column{n}": torch.full((3,), index) for n in range(4)}}

    def __len__(self):
        return 200


def test_joining_batches_of_a_worker_holds_no_file_open_for_each():
    few = len(os.listdir("/proc/self/fd")) + 100
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(few, soft), hard))
    try:
        joined = concatenate(DataLoader(_Numbers(), batch_size=2, num_workers=1), 200)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert joined["sample_id"].tolist() == list(range(200))
    assert torch.equal(joined["column3"], torch.arange(200)[:, None].expand(200, 3))


# Errors


def test_poses_without_a_heading_of_their_own_cannot_keep_it(make):
    with pytest.raises(
        ValueError, match=r"heading: these poses carry no heading .* 'histogram' or 'uniform'"
    ):
        make(heading="source")


def test_missing_keypoints_are_filled_in_and_have_no_confidence(make, batch):
    takes = ("crop", "crop_camera", "confidences")
    some = make(takes=takes, missing_keypoints=(0.5,)).batch(KEYS)
    is_kept = some["confidences"] > 0
    assert 0.4 < is_kept.float().mean() < 0.6
    assert torch.equal(some["keypoints"][is_kept], batch["keypoints"][is_kept])
    moved = (some["keypoints"] - batch["keypoints"]).norm(dim=-1)[~is_kept]
    assert 1 < moved.median() < 40  # a guess, but a near one
    none = make(takes=takes, missing_keypoints=(1,)).batch(KEYS)
    assert not none["confidences"].any()
    assert (none["keypoints"] == none["keypoints"][:, :1]).all()
    assert torch.equal(make(takes=takes).batch(KEYS)["confidences"], torch.ones(12, 24))


def test_a_sample_of_another_camera_is_seen_by_that_camera(make, kinect):
    changes = {
        "takes": ("points", "crop", "crop_camera"),
        "focal_factors": (0.7, 1.3),
        "pixel_factors": (0.3, 1.2),
    }
    changes |= {"depth_noise_m": 0, "keypoint_noise_px": 0}
    synthesizer = make(**changes)
    batch, depth = synthesizer.examples(KEYS)
    fx, _, cx, _ = batch["camera"].unbind(-1)
    assert fx.min() < 0.6 * kinect.fx < kinect.fx < fx.max()
    torch.testing.assert_close(project(batch["joints"], batch["camera"]), batch["true_keypoints"])
    for sample in range(len(KEYS)):
        image = depth[sample]
        v, u = image.nonzero(as_tuple=True)
        rays = (u - cx[sample]) / fx[sample] * image[v, u]
        points = batch["points"][sample]
        # Each point of the cloud is a pixel of that image.
        assert torch.cdist(points[:, [0, 2]], torch.stack([rays, image[v, u]], -1)).amin(1).max() < 2e-3
        crop, camera = batch["crop"][sample], batch["crop_camera"][sample]
        v, u = crop.nonzero(as_tuple=True)
        x = (u - camera[2]) / camera[0] * crop[v, u]
        assert (x.max() - rays.max()).abs() < 0.03
        assert (x.min() - rays.min()).abs() < 0.03
    alone = make(**changes).batch(KEYS[3:4])
    torch.testing.assert_close(alone["crop"], batch["crop"][3:4])


@pytest.mark.parametrize(
    ("settings", "change", "message"),
    [
        (ObservationRecipe, {"num_points": 0}, "num_points: expected at least 1, got 0"),
        (ObservationRecipe, {"crop_px": 0}, "crop_px: expected at least 1, got 0"),
        (ObservationRecipe, {"crop_px": 127}, "crop_px: expected an even number"),
        (ObservationRecipe, {"spacing_m": -1.0}, "spacing_m: expected a positive number"),
        (ObservationRecipe, {"normals": "pca"}, "normals: expected one of window, knn, open3d, got 'pca'"),
        (SynthesisSettings, {"heading": "front"}, "heading: expected one of source, histogram, uniform, got 'front'"),
        (SynthesisSettings, {"renderer": "opengl"}, "renderer: expected one of auto, zbuffer, torch, .*got 'opengl'"),
        (SynthesisSettings, {"distance_m": (3.0, 2.0)}, "distance_m: expected 0 < lowest <= highest"),
        (SynthesisSettings, {"pixel_factors": 0.5}, "pixel_factors: expected two numbers"),
        (SynthesisSettings, {"missing_keypoints": (0, 2)}, "missing_keypoints: expected shares between 0 and 1"),
        (SynthesisSettings, {"margin_px": -1.0}, "margin_px: expected a number of 0 or more, got -1"),
        (SynthesisSettings, {"keypoint_noise_px": -5.0}, "keypoint_noise_px: expected a number of 0 or more"),
    ],
)  # fmt: skip
def test_impossible_settings_are_errors_before_anything_is_rendered(settings, change, message):
    with pytest.raises(ValueError, match=message):
        settings(**change)
