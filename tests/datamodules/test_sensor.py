import math
import pickle
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import pytest
import torch

from datamodules import sensor as sensors
from datamodules.sensor import (
    AxialNoise,
    Clothing,
    CutOff,
    Disparity,
    Floor,
    FlyingPixels,
    Grazing,
    HeldObject,
    Holes,
    Lateral,
    LostLimb,
    MaskErrors,
    Multipath,
    Occluder,
    Range,
    Sensor,
    Shadow,
    Step,
    Tilt,
    WideShapes,
)
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SMPL, SparseSMPL
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.building import build
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import Camera, back_project, project
from ljn.geometry.rotations import CAMERA_FROM_BODY

KEYS = [(0, index) for index in range(12)]
TRUTH = ("true_keypoints", "joints", "pose", "betas", "gender", "camera", "sample_id")
STEPS = {
    name: step()
    for name, step in vars(sensors).items()
    if isinstance(step, type) and issubclass(step, Step) and step is not Step
}
"""Each step with its defaults."""
OF_IMAGES = {name: step for name, step in STEPS.items() if type(step).expose is not Step.expose}
PRESETS = ("gaussian", "kinect_v2", "structured_light", "low_resolution", "clutter", "clothing", "realistic")
HANDS, FEET = ([JOINT_INDEX[f"{side}_{part}"] for side in "lr"] for part in ("hand", "foot"))


@dataclass(frozen=True, kw_only=True)
class Mark(Step):
    """A step of one's own: every pixel of the body shows its strength and its first draw."""

    def expose(self, shot, rng, strength):
        shot.depth[shot.depth > 0] = 10 * strength + rng.random()


@pytest.fixture(scope="module")
def make(body_models, source, kinect):
    """Builds a synthesizer of twelve embedded records with a sensor, or steps; float64, without noise of keypoints."""
    records = source.records("val", 12, seed=2)
    layer = SparseSMPL(body_models).double()

    def build_one(sensor=None, takes=("points",), **changes):
        if isinstance(sensor, dict):
            sensor = Sensor(sensor)
        settings = SynthesisSettings(**{"depth_noise_m": 0.0, "keypoint_noise_px": 0.0, **changes})
        given = (settings, ObservationRecipe(64), takes, (0, 0), torch.float64)
        synthesizer = DepthSynthesizer(records, body_models, kinect, *given, sensor=sensor)
        synthesizer.__dict__["_smpl"] = layer  # building it would take longer than all the rest
        return synthesizer

    return build_one


@pytest.fixture(scope="module")
def plain(make):
    """The batch of twelve bodies without a sensor, and their depth images `(12, H, W)`."""
    batch, depth = make().examples(KEYS)
    return batch, depth.numpy()


@pytest.fixture(scope="module")
def preset(compose_config):
    """A preset's sensor, and what else it sets of a synthesizer."""

    def read(name):
        cfg = compose_config(f"data/sensor={name}").data
        factors = {key: tuple(cfg.synthesis[key]) for key in ("focal_factors", "pixel_factors")}
        return None if cfg.sensor is None else build(cfg.sensor), factors

    return read


def plane(z, degrees=0.0, focal=4000.0, size=121):
    """A plane in an image, but for 2 pixels around it, turned about the camera's y; and its camera."""
    camera = Camera(focal, focal, (size - 1) / 2, (size - 1) / 2, size, size)
    x = (np.arange(size) - camera.cx) / focal
    angle = math.radians(degrees)
    depth = np.tile(z * math.cos(angle) / (math.sin(angle) * x + math.cos(angle)), (size, 1)).astype(
        np.float32
    )
    depth[:2] = depth[-2:] = depth[:, :2] = depth[:, -2:] = 0
    return depth, camera


def take(step, depth, camera, key=0, strength=1.0, joints=None):
    """A copy of the image as a chain of this one step takes it."""
    taken = depth.copy()
    joints = np.full((24, 3), 9.0) if joints is None else joints
    Sensor({"step": step}, strength).expose(taken, camera, joints, [key])
    return taken


def take_bodies(step, plain, kinect, keys=range(3)):
    """Yields each body's image and joints, and the image as the step takes it; some times over."""
    batch, depth = plain
    for image, joints in zip(depth, batch["joints"].numpy()):
        for key in keys:
            yield image, joints, take(step, image, kinect, key, joints=joints)


def beside(mask, steps=1):
    """A mask `(H, W)` grown by its four neighbours, some times."""
    for _ in range(steps):
        padded = np.pad(mask, 1)
        sides = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
        mask = mask | np.any(sides, 0)
    return mask


def points_of(depth, camera):
    """The points `(N, 3)` of an image and their pixels `(N, 2)`."""
    v, u = np.nonzero(depth)
    pixels = torch.from_numpy(np.stack([u, v], -1)).float()
    return back_project(pixels, torch.from_numpy(depth[v, u]), camera.intrinsics()).numpy(), pixels.numpy()


# What a camera adds


@pytest.mark.parametrize(
    ("terms", "millimetres"),
    [
        (  # Fankhauser et al. 2015
            AxialNoise().terms,
            lambda z, a: 1.5 - 0.5 * z + 0.3 * z * z + 0.1 * z**1.5 * a**2 / (math.pi / 2 - a) ** 2,
        ),
        (  # Nguyen et al. 2012, written out
            (0.001504, -0.00152, 0.0019, 0.0001, -0.5),
            lambda z, a: 1.2 + 1.9 * (z - 0.4) ** 2 + 0.1 / math.sqrt(z) * a**2 / (math.pi / 2 - a) ** 2,
        ),
    ],
    ids=["kinect v2", "kinect v1"],
)
def test_axial_noise_has_the_published_standard_deviation_on_inclined_planes(terms, millimetres):
    step = AxialNoise(terms=terms)
    for z in (0.8, 1.5, 3.0, 4.5):
        for degrees in (0, 30, 60, 75):
            expected = millimetres(z, math.radians(degrees)) / 1000
            assert step.sigma_m(z, math.radians(degrees)) == pytest.approx(expected, rel=1e-9)
            depth, camera = plane(z, degrees)
            noise = (take(step, depth, camera) - depth)[4:-4, 4:-4]
            scale = step.sigma_m(depth[4:-4, 4:-4], math.radians(degrees))  # z varies a little over the plane
            assert (noise / scale).std() == pytest.approx(1, rel=0.04), (z, degrees)
            assert abs((noise / scale).mean()) < 0.04


def test_axial_noise_counts_no_angle_beyond_80_degrees():
    step = AxialNoise()
    assert step.sigma_m(2.0, math.radians(89)) == step.sigma_m(2.0, math.radians(80))
    depth, camera = plane(2.0, 86, focal=40_000)
    noise = (take(step, depth, camera) - depth)[4:-4, 4:-4]
    assert noise.std() == pytest.approx(float(step.sigma_m(2.0, 9.0)), rel=0.05)


def test_a_jump_of_depth_is_no_slope():
    depth, camera = plane(2.0)
    depth[:, 60:] -= np.where(depth[:, 60:] > 0, np.float32(0.5), 0)
    noise = (take(AxialNoise(), depth, camera) - depth)[4:-4]
    assert noise[:, 58:62].std() < 1.3 * AxialNoise().sigma_m(2.0, 0.0)
    assert np.array_equal(take(Grazing(rate=1), depth, camera), depth)


def test_disparity_lies_on_its_grid():
    step = Disparity(noise_px=0)
    depth, camera = plane(3.0, 40, focal=400)
    values = np.unique(take(step, depth, camera)[4:-4, 4:-4]).astype(float)
    steps = 43.5 / values / step.step_px
    assert np.abs(steps - steps.round()).max() < 1e-3
    assert np.array_equal(np.diff(steps[::-1].round()), np.ones(len(values) - 1)), "none is left out"
    near = np.searchsorted(values, 3.0)
    assert np.diff(values)[near - 1] == pytest.approx(0.026, abs=0.0005)
    assert np.abs(take(step, depth, camera) - depth).max() < 0.55 * np.diff(values).max()


def test_disparity_noise_adds_to_the_steps_and_strength_makes_them_wider():
    step = Disparity(noise_px=0.2)
    depth, camera = plane(2.0)
    for strength in (1.0, 2.0):
        read = 43.5 / strength / take(step, depth, camera, strength=strength)[4:-4, 4:-4]
        assert read.std() == pytest.approx(math.hypot(0.2, 0.125 / math.sqrt(12)), rel=0.05)


def test_flying_pixels_are_a_share_of_the_border_and_lie_behind():
    step = FlyingPixels(rate=0.3, behind_m=(0.5, 0.5))
    depth, camera = plane(2.0)
    body = depth > 0
    border = body & beside(~body)
    moved, number = 0, 0
    for key in range(20):
        taken = take(step, depth, camera, key)
        assert np.array_equal(taken[~border], depth[~border])
        assert ((taken >= depth) & (taken <= depth + 0.5)).all()
        moved += (taken != depth).sum()
        number += border.sum()
    assert moved / number == pytest.approx(0.3, abs=0.02)


def test_flying_pixels_at_a_jump_lie_between_its_surfaces():
    step = FlyingPixels(rate=1, jump_m=0.1)
    depth, camera = plane(2.0)
    depth[3:-3, 60:-3] = 3.0
    taken = take(step, depth, camera)
    between = taken[10:-10, 59]
    assert ((between >= 2) & (between < 3)).all()
    assert between.std() > 0.1
    assert np.array_equal(taken[10:-10, 60], depth[10:-10, 60]), "of the farther surface none"
    depth[3:-3, 60:-3] = 2.05
    assert np.array_equal(take(step, depth, camera)[10:-10, 10:-10], depth[10:-10, 10:-10])


def test_grazing_loses_its_share_above_its_angle_and_nothing_below():
    step = Grazing(angle_deg=75, rate=0.7)
    depth, camera = plane(2.0, 80)
    assert (take(step, depth, camera)[4:-4, 4:-4] == 0).mean() == pytest.approx(0.7, abs=0.02)
    assert (take(step, depth, camera, strength=0.5)[4:-4, 4:-4] == 0).mean() == pytest.approx(0.35, abs=0.02)
    depth, camera = plane(2.0, 70)
    assert np.array_equal(take(step, depth, camera), depth)


def test_lateral_leaves_a_plane_and_frays_its_edge_as_often_as_a_rounded_normal_number_crosses_it():
    step = Lateral(sigma_px=0.8)
    depth, camera = plane(2.0, 30)
    size = len(depth)
    lost, won = np.zeros(2), np.zeros(2)
    for key in range(20):
        taken = take(step, depth, camera, key)
        assert np.array_equal(taken[8:-8, 8:-8], depth[8:-8, 8:-8])
        rows = taken[10:-10]
        lost += [(rows[:, [2 + k, size - 3 - k]] == 0).mean() / 20 for k in range(2)]
        won += [(rows[:, [1 - k, size - 2 + k]] > 0).mean() / 20 for k in range(2)]
    # From k pixels inside the edge, a displacement of k + 1 leads outside; rounded, that is one of k + 0.5.
    expected = [1 - NormalDist(0, 0.8).cdf(k + 0.5) for k in range(2)]
    assert lost == pytest.approx(expected, abs=0.012)
    assert won == pytest.approx(expected, abs=0.012)


def test_a_shadow_is_as_wide_as_the_two_disparities_differ():
    focal, baseline = 366.0, 0.3
    depth, camera = plane(3.0, focal=focal, size=201)
    depth[20:-20, 100:110] = 2.0
    width = focal * baseline * (1 / 2 - 1 / 3)
    sides = set()
    for key in range(10):
        taken = take(Shadow(baseline_m=baseline), depth, camera, key)
        lost = (taken == 0) & (depth > 0)
        assert not lost[:20].any()
        assert not lost[-20:].any()
        row = np.nonzero(lost[100])[0]
        assert (lost[20:-20] == lost[100]).all()
        assert width - 1.75 <= len(row) <= width + 0.5  # neighbours on a slope of 0.75 px stay
        is_right = row[0] == 110
        assert row.tolist() == list(range(row[0], row[0] + len(row)))
        assert row[-1 if not is_right else 0] == (110 if is_right else 99)
        sides.add(is_right)
    assert sides == {False, True}


def test_multipath_is_smooth_bounded_and_behind():
    depth, camera = plane(2.0)
    for key in range(20):
        field = take(Multipath(most_m=0.05, scale=0), depth, camera, key)[2:-2, 2:-2] - 2
        assert -1e-6 < field.min() <= field.max() < 0.05
        for axis in range(2):
            assert np.abs(np.diff(field, axis=axis)).max() < 0.05 / 25
    scales = [take(Multipath(most_m=0, scale=0.01), depth, camera, key)[60, 60] / 2 for key in range(400)]
    assert np.std(scales) == pytest.approx(0.01, rel=0.1)
    assert np.mean(scales) == pytest.approx(1, abs=0.002)


def test_nothing_is_measured_out_of_range():
    depth, camera = plane(2.0, 60, focal=200)
    taken = take(Range(near_m=1.5, far_m=2.5), depth, camera)
    assert np.array_equal(taken, np.where((depth >= 1.5) & (depth <= 2.5), depth, 0))
    assert 0 < (taken > 0).sum() < (depth > 0).sum()


# What is around a person, and the mask


@pytest.mark.parametrize("name", ["Occluder", "Holes", "CutOff", "LostLimb", "Grazing", "Shadow", "Range"])
def test_steps_that_lose_pixels_change_no_other(name, plain, kinect):
    changed = 0
    for image, _, taken in take_bodies(OF_IMAGES[name], plain, kinect):
        assert ((taken == image) | (taken == 0)).all()
        changed += (taken != image).any()
    assert changed > 0 or name == "Range"


@pytest.mark.parametrize("size", [44, 204])
def test_an_occluder_covers_at_most_its_share_of_the_bodys_box(size):
    depth, camera = plane(2.0, size=size)
    step = Occluder(cover=(0.2, 0.2))
    lost = [((take(step, depth, camera, key) == 0) & (depth > 0)).mean() for key in range(200)]
    assert 0.15 < max(lost) < 0.26, "boxes and tables are askew"


def test_a_hole_is_no_wider_than_it_says():
    depth, camera = plane(2.0, size=104)
    lost = [(take(Holes(most=1, size=(0.05, 0.1)), depth, camera, k) == 0) & (depth > 0) for k in range(100)]
    areas = np.array([hole.sum() for hole in lost])
    assert 0.3 < (areas == 0).mean() < 0.7, "their number is uniform"
    assert np.pi * 5**2 < areas.max() < 1.1 * np.pi * 10**2
    assert max(np.ptp(np.nonzero(hole)[0]) for hole in lost if hole.any()) <= 2 * 10


@pytest.mark.parametrize("size", [44, 204])
def test_a_cut_takes_whole_rows_or_columns_at_one_side_uniform_up_to_its_part(size):
    depth, camera = plane(2.0, size=size)
    parts, sides = [], set()
    for key in range(300):
        left = take(CutOff(most=0.4), depth, camera, key)[2:-2, 2:-2] > 0
        rows, columns = left.any(1), left.any(0)
        assert np.array_equal(left, rows[:, None] & columns)
        edges = [rows[0], rows[-1], columns[0], columns[-1]]
        assert sum(edges) >= 3
        if not all(edges):
            sides.add(edges.index(False))
        parts.append(1 - left.mean())
    assert sides == {0, 1, 2, 3}
    assert np.quantile(parts, [0.1, 0.5, 0.9]) == pytest.approx([0.04, 0.2, 0.36], abs=0.05)


def test_a_lost_limb_leaves_no_point_within_its_radius(plain, kinect):
    lost = 0
    for image, joints, taken in take_bodies(LostLimb(radius_m=(0.15, 0.15)), plain, kinect):
        points, _ = points_of(image, kinect)
        left = taken[image > 0] > 0
        away = np.linalg.norm(points[:, None] - joints[HANDS + FEET], axis=-1)
        # All that is lost is within 15 cm of one of the four, and all that is within it is lost.
        lost_ones = [(left == (away[:, end] >= 0.15)).all() for end in range(4)]
        assert any(lost_ones)
        lost += (~left).any()
    assert lost > 20


def test_a_held_object_is_near_a_hand_and_before_what_is_there(plain, kinect):
    changed = 0
    for image, joints, taken in take_bodies(HeldObject(), plain, kinect):
        is_new = taken != image
        assert (taken[is_new & (image > 0)] < image[is_new & (image > 0)]).all()
        assert (taken[image > 0] > 0).all()
        if not is_new.any():
            continue
        changed += 1
        points, _ = points_of(np.where(is_new, taken, 0), kinect)
        away = np.linalg.norm(points[:, None] - joints[HANDS], axis=-1).max(0)
        assert away.min() < 0.6, "of one of the hands all of it"
        assert np.median(away.min()) < 0.6
    assert changed > 20


def test_floor_is_a_plane_near_the_feet(plain, kinect):
    seen = 0
    for image, joints, taken in take_bodies(Floor(), plain, kinect):
        assert np.array_equal(taken[image > 0], image[image > 0])
        points, pixels = points_of(np.where(image > 0, 0, taken), kinect)
        if len(points) < 10:
            continue
        seen += 1
        sides = np.stack([np.ones(len(points)), points[:, 2]], -1)
        fit = sides @ np.linalg.lstsq(sides, points[:, 1], rcond=None)[0]
        np.testing.assert_allclose(points[:, 1], fit, atol=1e-4)
        feet = project(torch.from_numpy(joints[FEET]), kinect.intrinsics()).numpy()
        away_px = np.linalg.norm(pixels[:, None] - feet, axis=-1).min(1)
        assert away_px.max() < 0.25 * kinect.fx / joints[FEET, 2].min() + 2
        assert np.abs(points[:, None, 2] - joints[FEET, 2]).min(1).max() < 0.4
    assert seen > 10


def test_mask_errors_change_two_pixels_of_the_border_at_most(plain, kinect):
    lost, won = 0, 0
    for image, _, taken in take_bodies(MaskErrors(), plain, kinect):
        body = image > 0
        assert np.array_equal(taken[~beside(~body, 2)], image[~beside(~body, 2)])
        assert not taken[~beside(body, 2)].any()
        is_new = ~body & (taken > 0)
        assert np.array_equal(taken[body & (taken > 0)], image[body & (taken > 0)])
        assert (taken[is_new] >= image[body].min()).all()
        lost += (body & (taken == 0)).any()
        won += is_new.any()
    assert lost > 5
    assert won > 5


# The person


def test_clothes_push_the_surface_outward_along_its_normals(body):
    vertices, faces = np.array(body.v_template, np.float64), np.array(body.faces)
    corners = vertices[faces]
    normals = np.zeros_like(vertices)
    for corner in range(3):
        of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.add.at(normals, faces[:, corner], of_faces)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    for key in range(5):
        dressed = vertices.copy()
        Sensor({"clothes": Clothing()}).dress(dressed, body, [key])
        moved = dressed - vertices
        outward = (moved * normals).sum(-1)
        assert outward.min() >= 0
        np.testing.assert_allclose(moved, outward[:, None] * normals, atol=1e-12)
        assert 0.002 < np.median(outward[body.weights[:, JOINT_INDEX["spine2"]] > 0.5]) < 0.05
        assert outward.max() < 0.25


def test_clothes_leave_hands_and_the_face(body):
    rest = np.array(body.v_template, np.float64)
    dressed = rest.copy()
    for key in range(10):
        Sensor({"clothes": Clothing()}).dress(dressed, body, [key])
    moved = np.linalg.norm(dressed - rest, axis=-1)
    hands = [JOINT_INDEX[f"{side}_{part}"] for side in "lr" for part in ("wrist", "hand")]
    assert moved[body.weights[:, hands].sum(1) > 0.999].max() == 0
    head = body.weights[:, JOINT_INDEX["head"]] > 0.999
    low, high = rest[head].min(0), rest[head].max(0)
    share = (rest - low) / (high - low)
    face = head & (share[:, 2] > 0.6) & (share[:, 1] < 0.7)
    assert face.sum() > 100
    assert moved[face].max() == 0
    assert moved[head & (share[:, 1] > 0.95)].min() > 0, "there is hair"


def test_clothes_change_the_image_and_leave_the_truth(make, plain):
    batch, depth = make({"clothes": Clothing()}).examples(KEYS)
    for name in TRUTH:
        assert torch.equal(batch[name], plain[0][name]), name
    seen, before = depth.numpy() > 0, plain[1] > 0
    assert (seen.sum((1, 2)) > before.sum((1, 2))).all()
    assert (before & ~seen).sum() < 0.001 * before.sum()


def test_joints_are_the_same_whether_an_image_is_taken_or_not(make):
    sensor = {name: STEPS[name] for name in ("Tilt", "WideShapes", "Clothing")}
    seen = make(sensor, initial_joints="noised").batch(KEYS)
    unseen = make(sensor, initial_joints="noised", takes=()).batch(KEYS)
    assert all(torch.equal(unseen[name], seen[name]) for name in unseen)


@pytest.mark.parametrize("name", ["Tilt", "WideShapes"])
def test_a_changed_body_and_its_truth_agree(make, plain, body_models, name):
    batch = make({"step": STEPS[name]}).batch(KEYS)
    changed = "pose" if name == "Tilt" else "betas"
    assert not torch.equal(batch[changed], plain[0][changed])
    output = SMPL(body_models).double()(batch["pose"].double(), batch["betas"].double(), batch["gender"])
    vertices, joints = (points @ CAMERA_FROM_BODY.T for points in output)
    moved = batch["joints"].double() - joints
    torch.testing.assert_close(moved, moved[:, :1].expand_as(moved), atol=1e-5, rtol=0)
    for mesh, points in zip(vertices + moved[:, ROOT, None], batch["points"]):
        assert torch.cdist(points[:, :3].double(), mesh).amin(1).max() < 0.04


def test_wide_shapes_are_wider_up_to_four(make, plain):
    betas = make({"step": WideShapes(factor=0.5)}).batch(KEYS)["betas"]
    torch.testing.assert_close(betas, 1.5 * plain[0]["betas"].clip(-4 / 1.5, 4 / 1.5))
    shape = Sensor({"step": WideShapes(factor=1)}).shape(np.array([1.0, -3, 2, -0.5]), [0])
    assert shape.tolist() == [2, -4, 4, -1]


@pytest.mark.parametrize("strength", [1.0, 0.5])
def test_tilts_angles_have_their_standard_deviations(strength):
    sensor = Sensor({"tilt": Tilt(pitch_deg=12, roll_deg=4)}, strength)
    turns = np.array([sensor.turn([key]) for key in range(1500)])
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.tile(np.eye(3), (1500, 1, 1)), atol=1e-12)
    pitch, roll = np.arctan2(turns[:, 0, 2], turns[:, 0, 0]), np.arctan2(turns[:, 2, 1], turns[:, 1, 1])
    assert np.degrees([pitch.std(), roll.std()]) == pytest.approx([12 * strength, 4 * strength], rel=0.06)
    assert np.degrees([pitch.mean(), roll.mean()]) == pytest.approx([0, 0], abs=1)


# The chain


@pytest.mark.parametrize("name", OF_IMAGES)
def test_every_step_of_images_is_the_same_again_and_leaves_a_finite_image(name, plain, kinect):
    changed = 0
    for first, again in zip(*(take_bodies(OF_IMAGES[name], plain, kinect, range(2)) for _ in range(2))):
        assert np.array_equal(first[2], again[2])
        assert np.isfinite(first[2]).all()
        assert first[2].min() >= 0
        changed += (first[2] != first[0]).any()
    assert changed >= 5 or name == "Range"


@pytest.mark.parametrize("off", ["strength", "share"])
def test_no_strength_or_no_share_leaves_everything_bit_for_bit(make, plain, off):
    if off == "strength":
        sensor = Sensor(STEPS, strength=0)
    else:
        sensor = Sensor({name: replace(step, share=0) for name, step in STEPS.items()})
    batch, depth = make(sensor).examples(KEYS)
    assert np.array_equal(depth.numpy(), plain[1])
    assert all(torch.equal(batch[name], plain[0][name]) for name in batch)


def marks(sensor, keys):
    """What `Mark` leaves of each key: the strength, and the draw."""
    depth, camera = plane(0.5, size=21)
    found = []
    for key in keys:
        taken = depth.copy()
        sensor.expose(taken, camera, np.full((24, 3), 9.0), [key])
        found.append(math.nan if np.array_equal(taken, depth) else float(taken.max()))
    return np.array(found)


def test_a_share_of_the_samples_goes_through_a_step():
    marked = marks(Sensor({"mark": Mark(share=0.3)}), range(600))
    assert np.mean(marked > 0) == pytest.approx(0.3, abs=0.05)


def test_strengths_vary_uniformly_up_to_the_chains():
    marked = marks(Sensor({"mark": Mark()}, strength=20, varies=True), range(600)) - 0.5
    assert np.quantile(marked, [0.1, 0.5, 0.9]) == pytest.approx([20, 100, 180], abs=14)
    fixed = marks(Sensor({"mark": Mark()}, strength=20), range(20))
    assert ((fixed > 200) & (fixed < 201)).all()


def test_a_steps_draws_are_its_own():
    other = [
        AxialNoise(),
        AxialNoise(share=0),
        AxialNoise(share=0.5),
        Lateral(sigma_px=2),
        Holes(most=9),
        Tilt(),
    ]
    found = [
        marks(Sensor({"other": step, "mark": Mark(share=0.5)}, varies=True), range(30)) for step in other
    ]
    is_marked = ~np.isnan(found[-1])
    assert 5 < is_marked.sum() < 25
    for values in found:
        assert np.array_equal(values[is_marked], found[-1][is_marked])
    longer = Sensor({"other": Tilt(), "mark": Mark(share=0.5), "last": Tilt()}, varies=True)
    assert np.array_equal(marks(longer, range(30)), found[-1], equal_nan=True)
    two = Sensor({"a": Mark(), "b": Mark()})
    assert (marks(two, range(9)) != marks(Sensor({"a": Mark(), "b": Mark(share=0)}), range(9))).all()


def test_where_hardly_anything_would_be_left_the_image_stays():
    depth, camera = plane(2.0)
    assert np.array_equal(take(Range(far_m=1), depth, camera), depth)
    assert np.array_equal(take(CutOff(most=1), depth, camera, strength=9), depth)
    empty = np.zeros_like(depth)
    assert not take(MaskErrors(gain=1), empty, camera).any()


def test_a_body_at_the_images_edge_is_taken_too():
    depth, camera = np.full((40, 30), 2.0, np.float32), Camera(50, 50, 15, 20, 30, 40)
    for step in OF_IMAGES.values():
        for key in range(3):
            taken = take(step, depth, camera, key, joints=np.tile([0.3, 0.5, 2.0], (24, 1)))
            assert taken.shape == depth.shape
            assert np.isfinite(taken).all()


def test_a_sample_depends_on_its_key_alone(make, preset):
    sensor, factors = preset("realistic")
    synthesizer = make(sensor, **factors)
    batch = synthesizer.batch(KEYS)
    for keys in ([KEYS[4]], [KEYS[9], KEYS[4], KEYS[9], KEYS[0]]):
        other = synthesizer.batch(keys)
        for name in batch:
            expected = batch[name][[index for _, index in keys]]
            torch.testing.assert_close(other[name], expected, atol=1e-5, rtol=0)
    later = synthesizer.batch([(1, index) for _, index in KEYS])
    assert (later["points"] != batch["points"]).flatten(1).any(1).all()


def test_a_mirrored_use_is_the_mirror_image_where_no_step_takes_images(make, kinect):
    sensor = {name: STEPS[name] for name in ("Tilt", "WideShapes", "Clothing")}
    first, second = (make(sensor).examples([(*key, use) for key in KEYS]) for use in range(2))
    assert torch.equal(second[1], first[1].flip(-1))
    assert torch.equal(second[0]["betas"], first[0]["betas"])
    # A third use is the first one but for noise, of which there is none.
    assert torch.equal(make(sensor).examples([(*key, 2) for key in KEYS])[1], first[1])


def test_each_use_of_a_render_is_taken_anew(make):
    synthesizer = make({"axial": AxialNoise(), "tilt": Tilt()})
    first, third = (synthesizer.examples([(*key, use) for key in KEYS]) for use in (0, 2))
    assert torch.equal(first[0]["joints"], third[0]["joints"])
    noise = [(third[1] - first[1])[i][first[1][i] > 0] for i in range(12)]
    assert all(0.001 < float(values.std()) < 0.02 for values in noise)


def test_a_synthesizer_with_a_sensor_survives_its_way_to_another_process(make, preset):
    synthesizer = make(preset("realistic")[0])
    batch = synthesizer.batch(KEYS)
    other = pickle.loads(pickle.dumps(synthesizer))
    other.__dict__["_smpl"] = synthesizer._smpl
    other = other.batch(KEYS)
    assert all(torch.equal(other[name], batch[name]) for name in batch)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_makes_samples(make, preset, name):
    sensor, factors = preset(name)
    batch, depth = make(sensor, **factors).examples(KEYS)
    assert all(value.isfinite().all() for value in batch.values())
    assert ((depth > 0).sum((1, 2)) >= 40).all()


def test_every_preset_is_listed(compose_config):
    from tests.tasks.test_config import CONF

    assert sorted(PRESETS) == sorted(path.stem for path in (CONF / "data" / "sensor").glob("*.yaml"))


@pytest.mark.parametrize(
    ("make_bad", "message"),
    [
        (lambda: AxialNoise(share=2), r"AxialNoise.share: expected a share between 0 and 1, got 2"),
        (lambda: Lateral(share=-0.1), r"Lateral.share: expected a share"),
        (lambda: Lateral(sigma_px="much"), r"Lateral.sigma_px: expected a number or numbers, got 'much'"),
        (lambda: Lateral(sigma_px=None), r"Lateral.sigma_px: expected a number"),
        (lambda: Grazing(rate=math.nan), r"Grazing.rate: expected a number"),
        (lambda: AxialNoise(terms=(1, 2, 3, 4)), r"AxialNoise.terms: expected 5 numbers"),
        (lambda: AxialNoise(terms=(1, 2, 3, 4, 0.3)), r"AxialNoise.terms: .* a multiple of 0.5"),
        (lambda: Holes(size=(0.1, "b")), r"Holes.size: expected"),
        (lambda: Holes(size=0.1), r"Holes.size: expected 2 numbers"),
        (lambda: AxialNoise(terms=0.1), r"AxialNoise.terms: expected numbers, got 0.1"),
        (lambda: Lateral(sigma_px=(0.1, 0.2)), r"Lateral.sigma_px: expected a number, got"),
        (lambda: Floor(reach_m=(0.1, 0.2, 0.3)), r"Floor.reach_m: expected 2 numbers"),
        (lambda: FlyingPixels(behind_m=(1.0, 0.5)), r"FlyingPixels.behind_m: expected 2 numbers"),
        (lambda: Sensor({"blur": 3}), r"sensor.steps.blur: expected a step of datamodules.sensor, got int"),
        (lambda: Sensor({}, strength=-1), r"sensor.strength: expected a number of 0 or more, got -1"),
        (lambda: Sensor({}, strength=math.inf), r"sensor.strength: expected a number"),
    ],
)
def test_bad_settings_raise_with_the_fields_name(make_bad, message):
    with pytest.raises(ValueError, match=message):
        make_bad()
