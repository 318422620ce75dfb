from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from ljn.body import SMPL
from ljn.body.skeleton import JOINT_INDEX, ROOT
from ljn.geometry.camera import Camera
from ljn.pipeline.depth import body_depth, person_mask
from ljn.pipeline.person import find_person, pieces_of
from ljn.pipeline.report import Report
from ljn.render import get_renderer

CAMERA = Camera(366.458, 366.736, 206.470, 253.026, 424, 512)


@pytest.fixture(scope="module")
def person():
    """Somebody who stands, arms held down and forward: `(H, W)`, metres."""
    body = SMPL.load()
    pose = torch.zeros(24, 3)
    pose[JOINT_INDEX["l_shoulder"], 2], pose[JOINT_INDEX["r_shoulder"], 2] = -1.1, 1.1
    pose[JOINT_INDEX["l_elbow"], 1] = -1.2
    vertices, joints = body(pose.flatten(), torch.zeros(10))
    vertices = (vertices - joints[ROOT]) * torch.tensor([1.0, -1, -1]) + torch.tensor([0.1, 0, 2.3])
    return get_renderer("zbuffer")(vertices[None], body.faces, CAMERA)[0].numpy()


def test_pieces_are_those_of_a_slow_search():
    rng = np.random.default_rng(0)
    steps = rng.integers(0, 4, (30, 40))
    metres = np.where(steps > 0, 1.0 + 0.5 * steps, 0).astype(np.float32)
    pieces = pieces_of(metres, Camera(50.0, 60.0, 20.0, 15.0, 40, 30))
    number = 0
    for step in (1, 2, 3):
        labels, count = ndimage.label(steps == step, np.ones((3, 3)))
        number += count
        for label in range(1, count + 1):
            found = np.unique(pieces.labels[labels == label])
            assert len(found) == 1
            assert pieces.pixels[found[0]] == np.count_nonzero(labels == label)
            z = 1.0 + 0.5 * step
            assert pieces.area_m2[found[0]] == pytest.approx(pieces.pixels[found[0]] * z * z / 3000)
            beside = [steps[place] for place in _around(labels == label)]
            others = np.count_nonzero(beside)
            assert pieces.is_beside[found[0]] == pytest.approx(others / len(beside) if others else 0)
    assert number == len(pieces.pixels)
    assert (pieces.labels[metres == 0] == -1).all()


def _around(is_piece):
    """The pixels beside each pixel of a piece that are not of it, one for each pair of eight neighbours."""
    height, width = is_piece.shape
    for v, u in zip(*np.nonzero(is_piece)):
        for row in range(max(0, v - 1), min(height, v + 2)):
            for column in range(max(0, u - 1), min(width, u + 2)):
                if not is_piece[row, column]:
                    yield row, column


def test_an_image_of_noise_has_a_piece_for_each_pixel_and_is_refused():
    camera, metres = Camera(92.0, 92.0, 52.0, 63.0, 106, 128), np.ones((128, 106), np.float32)
    metres[::2, ::2], metres[1::2, ::2], metres[::2, 1::2] = 2, 3, 4  # no two neighbours are alike
    assert len(pieces_of(metres, camera).pixels) == metres.size
    with pytest.raises(ValueError, match=r"of the neighbouring pixels lie on different surfaces.*noise"):
        body_depth(metres, camera)


def test_thickness_is_that_of_the_largest_square_inside():
    metres = np.zeros((40, 40), np.float32)
    metres[5:25, 5:12] = 2.0  # 7 px wide
    metres[30, 3:30] = 2.0
    pieces = pieces_of(metres, Camera(100.0, 100.0, 20.0, 20.0, 40, 40))
    assert sorted(pieces.thickness_m) == pytest.approx([1 * 2 / 100, 7 * 2 / 100])


@pytest.mark.parametrize("gap_m", [0.15, 0.25, 0.4, 1.6, 4.0])
@pytest.mark.parametrize("wide_px", [1, 2, 4])
def test_a_mask_too_wide_adds_no_background(gap_m, wide_px, person):
    body = person > 0
    mask = ndimage.binary_dilation(body, iterations=wide_px)
    scene = np.where(body, person, person.max() + np.float32(gap_m))
    report = Report()
    found = body_depth(scene, CAMERA, mask, report)
    assert np.count_nonzero((found > 0) & ~body) <= 0.02 * np.count_nonzero(mask & ~body)
    np.testing.assert_array_equal(found[body], person[body])
    dropped = report.facts["dropped"]
    assert sum(dropped.values()) >= 0.98 * np.count_nonzero(mask & ~body)


def test_limbs_behind_the_body_are_no_rim():
    camera, metres = Camera(200.0, 200.0, 100.0, 100.0, 200, 200), np.zeros((200, 200), np.float32)
    for left in (70, 122):  # thin, behind, and together 1.3 m long: but beside the body only where they begin
        metres[100:170, left : left + 8] = 2.4
    metres[30:110, 70:130] = 2.0
    found = find_person(metres, camera)
    np.testing.assert_array_equal(found.depth, metres)
    assert found.num_rim == 0


@pytest.mark.parametrize("share", [0.001, 0.005, 0.03])
@pytest.mark.parametrize("code", [65535, 65000])
def test_codes_for_nothing_are_no_depth(share, code, person):
    millimetres = (1000 * person).round().astype(np.uint16)
    body = np.flatnonzero(person)
    lost = np.random.default_rng(0).choice(body, int(share * len(body)), replace=False)
    millimetres.flat[lost] = code
    report = Report()
    found = body_depth(millimetres, CAMERA, person > 0, report)
    assert report.facts["invalid"] == len(lost)
    assert (found.flat[lost] == 0).all()
    assert np.count_nonzero(found) >= np.count_nonzero(person) - 2 * len(lost)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, -np.inf])
def test_outside_the_mask_anything_may_stand(value, person):
    scene = np.where(person > 0, person, np.float32(value))
    np.testing.assert_array_equal(body_depth(scene, CAMERA, person > 0), person)
    np.testing.assert_array_equal(body_depth(scene, CAMERA), person)
    np.testing.assert_array_equal(body_depth(scene[..., None], CAMERA, (person > 0)[..., None]), person)


@pytest.mark.parametrize("z", [1.0, 4.0, 5.0, 8.0])
def test_stray_pixels_are_dropped(z, person):
    lost = np.random.default_rng(1).choice(np.flatnonzero(person), 20, replace=False)
    scene = person.copy()
    scene.flat[lost] = z
    found = body_depth(scene, CAMERA)
    assert (found.flat[lost] == 0).all()
    assert found.max() < person.max() + 0.1


def test_what_is_far_away_is_dropped_and_much_of_it_is_doubted(person):
    scene = person.copy()
    scene[:60, :70] = person.max() + 1.5  # a board behind, in the corner of the mask
    report = Report()
    found = body_depth(scene, CAMERA, None, report)
    np.testing.assert_array_equal(found, person)
    assert report.facts["dropped"]["far"] == 60 * 70
    assert "is somebody or something else in the mask" in report.warnings[0]
    with pytest.raises(ValueError, match="an error, because of strict=true"):
        body_depth(scene, CAMERA, None, Report(is_strict=True))


def test_a_body_of_half_the_size_is_doubted_and_one_of_a_third_refused(person):
    half = Camera(CAMERA.fx, CAMERA.fy, 103.0, 126.0, 212, 256)  # of an image that was not halved
    report = Report()
    body_depth(np.ascontiguousarray(person[::2, ::2]), half, None, report)
    assert "little for a person" in report.warnings[0]
    with pytest.raises(ValueError, match=r"less than a person.*scale fx, fy, cx and cy"):
        body_depth(person, Camera(1081.0, 1081.0, CAMERA.cx, CAMERA.cy, 424, 512))


def test_a_principal_point_is_that_of_the_image(person):
    with pytest.raises(ValueError, match="if they were swapped"):
        body_depth(person, replace(CAMERA, cx=253.0, cy=206.5))
    half = np.ascontiguousarray(person[::2, ::2])
    with pytest.raises(ValueError, match="that of a larger image"):
        body_depth(half, replace(CAMERA, width=212, height=256))
    body_depth(person, replace(CAMERA, cx=90.0), None, report := Report())
    assert "far from the middle" in report.warnings[0]
    body_depth(person, CAMERA, None, report := Report())
    assert not report.warnings


def test_who_lies_with_the_head_towards_the_camera_is_no_doubt():
    body = SMPL.load()
    pose = torch.zeros(24, 3)
    pose[JOINT_INDEX["l_shoulder"], 2], pose[JOINT_INDEX["r_shoulder"], 2] = -1.3, 1.3
    vertices, joints = body(pose.flatten(), torch.zeros(10))
    lying = (vertices - joints[ROOT])[:, [0, 2, 1]] * torch.tensor([1.0, -1, -1]) + torch.tensor(
        [0, 0.4, 2.3]
    )
    depth = get_renderer("zbuffer")(lying[None], body.faces, CAMERA)[0].numpy()
    body_depth(depth, CAMERA, None, report := Report())
    assert report.facts["area_m2"] < 0.15  # no more than of a child who stands
    assert not report.warnings


def test_what_reaches_farther_than_a_person_is_doubted():
    metres = np.zeros((512, 424), np.float32)
    metres[190:320, 40:95] = metres[190:320, 325:380] = metres[250:260, 40:380] = 2.4
    metres[metres > 0] += np.nonzero(metres)[1].astype(np.float32) / 2000  # not flat
    body_depth(metres, CAMERA, None, report := Report())
    assert report.facts["area_m2"] < 0.85
    assert "much for a person: are there two" in report.warnings[0]


def _with_another(person, aside_px, seen_px):
    """Somebody else 0.6 m behind and aside, whom a table hides from the row `seen_px` on."""
    aside = np.roll(np.where(person > 0, person + np.float32(0.6), 0), -aside_px, 1)
    aside[seen_px:] = 0
    return np.where(person > 0, person, aside)


def test_a_second_person_is_doubted(person):
    body_depth(_with_another(person, 90, 220), CAMERA, None, report := Report())
    assert "somebody else" in " ".join(report.warnings)


def test_two_people_who_are_too_large_for_one_are_refused(person):
    with pytest.raises(
        ValueError, match=r"much for a person, and a piece.* apart.*give a mask of the person alone"
    ):
        body_depth(_with_another(person, 150, 270), CAMERA)


def test_masks_as_people_have_them(person):
    body = person > 0
    grey = np.full((*body.shape, 3), 120, np.uint8)
    forms = {
        "boolean": body,
        "ones": body.astype(np.uint8),
        "bytes": 255 * body.astype(np.uint8),
        "one label": 7 * body.astype(np.int32),
        "soft": np.where(body, 0.98, 0.01),
        "matte": np.where(body, 250, 2).astype(np.uint8),
        "cut-out": np.dstack([grey, 255 * body.astype(np.uint8)]),
        "colours": np.where(body[..., None], grey, 0),
        "opaque": np.dstack([np.where(body[..., None], grey, 0), np.full(body.shape, 255, np.uint8)]),
        "a channel": body[..., None],
    }
    for name, mask in forms.items():
        np.testing.assert_array_equal(person_mask(mask), body, err_msg=name)


def test_of_an_index_map_the_person_has_to_be_chosen(person):
    body = person > 0
    labels = np.where(body, 3, 1).astype(np.uint8)
    labels[:20] = 0
    with pytest.raises(ValueError, match=r"index map of the numbers 0 .*task.mask_id=1"):
        person_mask(labels)
    np.testing.assert_array_equal(person_mask(labels, 3), labels == 3)
    with pytest.raises(ValueError, match="no pixel has the number 9; there are 0"):
        person_mask(labels, 9)
