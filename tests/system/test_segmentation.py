import cv2
import numpy as np
import pytest

from ljn.geometry.camera import Camera
from ljn.system.depth_only import DepthOnly, background_plate
from ljn.system.floor import find_floor, heights_m
from ljn.system.recording import RgbdFrame
from ljn.system.segmentation import GreenCurtain, find_green

CAMERA = Camera(366.0, 366.0, 256.0, 206.0, 512, 424)
GREEN, SHIRT, SKIN, WALL = (40, 150, 60), (170, 60, 70), (200, 160, 130), (150, 145, 140)
FLOOR_M, CURTAIN_M, PERSON_M = 0.95, 3.0, 2.1


def iou(mask, truth):
    return np.count_nonzero(mask & truth) / np.count_nonzero(mask | truth)


def room(seed=0, people=(0.0,), curtain=GREEN, clothes=SHIRT, curtain_is_measured=True):
    """A frame of figures of boxes on a floor before a curtain, with noise; and the true mask."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:424, :512].astype(np.float32)
    ray_x, ray_y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    with np.errstate(divide="ignore"):
        floor = np.where(ray_y > 0, FLOOR_M / np.maximum(ray_y, 1e-6), np.inf)
    depth = np.full(u.shape, CURTAIN_M + 0.3, np.float32)
    rgb = np.full((424, 512, 3), WALL, np.float32)
    is_curtain = np.abs(ray_x * CURTAIN_M) < 1.6
    depth[is_curtain] = (CURTAIN_M + 0.03 * np.cos(40 * ray_x))[is_curtain]
    rgb[is_curtain] = (np.array(curtain) * (0.85 + 0.15 * np.cos(40 * ray_x))[..., None])[is_curtain]
    is_floor = floor < depth
    depth[is_floor] = floor[is_floor]
    rgb[is_floor] = (130, 110, 90)
    if not curtain_is_measured:
        depth[is_curtain & ~is_floor] = 0
        depth[~is_curtain & ~is_floor] = 0
    mask = np.zeros(u.shape, bool)
    for x in people:
        a, b = ray_x * PERSON_M - x, ray_y * PERSON_M
        head = a**2 + (b + 0.68) ** 2 < 0.11**2
        trunk = (np.abs(a) < 0.2) & (b > -0.58) & (b < 0.1)
        arms = (np.abs(np.abs(a) - 0.34) < 0.045) & (b > -0.55) & (b < 0.05)
        shoulders = (np.abs(a) < 0.38) & (np.abs(b + 0.52) < 0.05)
        legs = (np.abs(np.abs(a) - 0.11) < 0.075) & (b >= 0.1) & (b < FLOOR_M)
        person = head | trunk | arms | shoulders | legs
        mask |= person
        depth[person] = (PERSON_M - 0.1 * np.cos(a / 0.25))[person]
        rgb[person] = clothes
        rgb[head] = SKIN
    depth = np.where(depth > 0, depth + 0.003 * rng.standard_normal(depth.shape), 0).astype(np.float32)
    rgb = np.clip(cv2.GaussianBlur(rgb, (0, 0), 0.6) + 5 * rng.standard_normal(rgb.shape), 0, 255)
    return RgbdFrame(0, "room", depth, rgb.astype(np.uint8)), mask


def test_a_person_before_a_curtain_is_found():
    frame, truth = room()
    segmenter = GreenCurtain()
    assert iou(segmenter(frame, CAMERA), truth) > 0.97
    assert segmenter.facts["has_floor"]
    assert segmenter.facts["curtain_m"] == pytest.approx(3.0, abs=0.05)


def test_the_outline_is_where_colours_change_although_depth_is_ragged():
    frame, truth = room()
    rng = np.random.default_rng(1)
    by = rng.integers(-2, 3, (2, *truth.shape))
    v, u = np.mgrid[:424, :512]
    ragged = frame.depth[(v + by[0]).clip(0, 423), (u + by[1]).clip(0, 511)]
    found = GreenCurtain()(frame._replace(depth=ragged), CAMERA)
    assert iou(found, truth) > 0.98
    assert (
        iou((ragged < 2.6) & (np.arange(424)[:, None] < 300), truth & (np.arange(424)[:, None] < 300)) < 0.95
    )


def test_hair_that_is_not_measured_belongs_to_the_person():
    frame, truth = room()
    depth = frame.depth.copy()
    depth[truth & (np.arange(424)[:, None] < 93)] = 0
    assert iou(GreenCurtain()(frame._replace(depth=depth), CAMERA), truth) > 0.97


def test_a_curtain_whose_depth_was_not_measured_is_enough():
    frame, truth = room(curtain_is_measured=False)
    segmenter = GreenCurtain()
    assert iou(segmenter(frame, CAMERA), truth) > 0.97
    assert "curtain_m" not in segmenter.facts


@pytest.mark.parametrize("colour", [(90, 190, 60), (20, 70, 35), (20, 150, 110)])
def test_the_curtains_own_green_is_learnt(colour):
    frame, truth = room(curtain=colour)
    assert iou(GreenCurtain()(frame, CAMERA), truth) > 0.96
    green, _ = find_green(frame.rgb)
    expected = np.array(colour[:2]) / sum(colour) - 1 / 3
    assert np.allclose(green.direction, expected, atol=0.03)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"curtain": (150, 150, 150)}, "green curtain behind the person, got 0.0 %"),
        ({"people": ()}, "expected a person, found nobody"),
        ({"people": (-0.75, 0.75)}, "several persons"),
        ({"clothes": (42, 140, 62)}, "clothes are green: 9.*segmentation=depth_only"),
    ],
)
def test_what_cannot_be_segmented_is_refused_with_the_reason(changes, message):
    with pytest.raises(ValueError, match=message):
        GreenCurtain()(room(**changes)[0], CAMERA)


def test_frames_without_colours_or_depth_or_of_another_size_are_refused():
    frame, _ = room()
    with pytest.raises(ValueError, match="expected colours, got none"):
        GreenCurtain()(frame._replace(rgb=None), CAMERA)
    with pytest.raises(ValueError, match=r"got none \(the file is cut short\)"):
        GreenCurtain()(RgbdFrame(0, "a", None, error="the file is cut short"), CAMERA)
    with pytest.raises(ValueError, match=r"frame.rgb: expected the camera's 512 x 424"):
        GreenCurtain()(frame._replace(rgb=frame.rgb[:-1]), CAMERA)
    for segmenter in (GreenCurtain(), DepthOnly()):
        with pytest.raises(ValueError, match="nothing"):
            segmenter(frame._replace(depth=np.zeros_like(frame.depth)), CAMERA)
    with pytest.raises(ValueError, match=r"frame.depth: expected the camera's 512 x 424"):
        DepthOnly()(frame._replace(depth=frame.depth[:-1]), CAMERA)


def test_the_floor_is_found_and_a_person_alone_is_none():
    frame, truth = room()
    floor = find_floor(frame.depth, CAMERA)
    assert np.allclose(floor, [0, -1, 0, FLOOR_M], atol=0.02)
    assert np.median(heights_m(frame.depth, CAMERA, floor)[400]) == pytest.approx(0, abs=0.01)
    assert find_floor(np.where(truth, frame.depth, np.float32(0)), CAMERA) is None
    assert find_floor(np.zeros_like(frame.depth), CAMERA) is None


def test_a_plate_is_the_median_of_what_was_measured():
    frames = [room(seed, people=())[0] for seed in range(5)]
    frames[0].depth[100:200] = 1.0
    for frame in frames[:3]:
        frame.depth[50, 60] = 0
    frames.append(RgbdFrame(5, "damaged", None, error="cut short"))
    plate = background_plate(frames)
    assert plate[50, 60] == 0
    assert np.abs(plate[150, 250:260] - 3).max() < 0.05
    with pytest.raises(ValueError, match="frames: expected depth images"):
        background_plate([])


def test_before_a_plate_a_person_is_found_and_followed(tmp_path):
    plate = background_plate(room(seed, people=())[0] for seed in range(5))
    frame, truth = room(9)
    assert iou(DepthOnly(plate)(frame, CAMERA), truth) > 0.95
    cv2.imwrite(str(tmp_path / "plate.png"), np.rint(1000 * plate).astype(np.uint16))
    segmenter = DepthOnly(tmp_path / "plate.png")
    assert iou(segmenter(frame, CAMERA), truth) > 0.95
    crowd = room(10, people=(-0.3, 0.9))[0]
    with pytest.raises(ValueError, match="several persons"):
        DepthOnly(plate)(crowd, CAMERA)
    followed = segmenter(crowd._replace(number=1), CAMERA)
    assert iou(followed, room(10, people=(-0.3,))[1]) > 0.93
    with pytest.raises(ValueError, match="several persons"):  # long after, nobody knows any more
        segmenter(crowd._replace(number=400), CAMERA)
    seeded = DepthOnly(plate, seed=(1.0, 0.0, 2.0))
    assert iou(seeded(crowd, CAMERA), room(10, people=(0.9,))[1]) > 0.93
    with pytest.raises(ValueError, match="plate: expected 512 x 424"):
        DepthOnly(plate[:-1])(frame, CAMERA)
    with pytest.raises(ValueError, match="seed: expected three numbers"):
        DepthOnly(seed=(1.0, 2.0))
