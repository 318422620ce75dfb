import numpy as np
import pytest

from ljn.body import SMPL
from ljn.geometry.camera import Camera
from ljn.pipeline.depth import body_depth
from ljn.pipeline.report import Report
from ljn.pipeline.scene import find_planes
from tests.rooms import Box, Room, body_in_room, render

CAMERA = Camera(212, 212, 96, 128, 192, 256)


@pytest.fixture(scope="module")
def standing():
    """Somebody who stands with the arms held down, in the body world: vertices `(V, 3)` and faces."""
    import torch

    body = SMPL.load()
    pose = torch.zeros(72)
    pose[:3] = 2 * np.pi / 3**1.5  # upright, facing the camera
    pose[3 * 16 + 2], pose[3 * 17 + 2] = -1.1, 1.1
    return body(pose, torch.zeros(10)).vertices.numpy().astype(np.float64), body.faces


def seen(standing, room, at=(0.1, 2.4), noise_m=0.002, heading=0.3):
    """A room's depth image with somebody in it, and the person's pixels."""
    body = render(body_in_room(standing[0], at, heading), standing[1], room, CAMERA)
    empty = room.depth(CAMERA)
    person = (body > 0) & (body < empty)
    depth = np.where(person, body, empty)
    return (depth + np.random.default_rng(0).normal(0, noise_m, depth.shape)).astype(np.float32), person


ROOMS = {
    "level": Room(),
    "wall 0.3 m behind": Room(walls=(-1.5, 1.5, 2.9)),
    "from above": Room(height_m=2.2, tilt=0.5),
    "from below, tilted aside": Room(height_m=0.5, tilt=-0.15, roll=0.1),
    "behind a table": Room(
        height_m=1.5,
        tilt=0.25,
        boxes=[Box((-1.3, 0.68, 2.3), (0.8, 0.04, 0.8)), Box((1.2, 0, 3.1), (0.6, 1.8, 0.5))],
    ),
}


@pytest.mark.parametrize("name", ROOMS)
def test_a_person_in_a_room_is_found_without_a_mask(name, standing):
    depth, person = seen(standing, ROOMS[name])
    report = Report()
    found = body_depth(depth, CAMERA, None, report) > 0
    assert np.count_nonzero(found & person) > 0.93 * np.count_nonzero(found | person)
    assert report.facts["planes"] >= 2
    assert not report.warnings


def test_an_empty_room_is_refused():
    depth = Room(boxes=[Box((-0.5, 0, 2.5), (0.8, 0.7, 0.6))]).depth(CAMERA)
    with pytest.raises(ValueError, match=r"without a mask, no person was found.*give a mask"):
        body_depth(depth, CAMERA)


def test_of_two_people_one_is_taken_with_a_doubt(standing):
    room = Room(walls=(-2.5, 2.5, 4))
    depth, _ = seen(standing, room, at=(-0.6, 2.6))
    other, is_other = seen(standing, room, at=(0.6, 2.8), heading=-0.5)
    report = Report()
    found = body_depth(np.where(is_other, other, depth), CAMERA, None, report) > 0
    assert "2 things have a person's size and shape" in " ".join(report.warnings)
    assert np.count_nonzero(found) < 1.2 * np.count_nonzero(is_other)


def test_the_figure_that_fits_is_taken(standing):
    room = Room(walls=(-2.5, 2.5, 4))
    depth, first = seen(standing, room, at=(-0.6, 2.6))
    other, second = seen(standing, room, at=(0.6, 2.8), heading=-0.5)
    scene = np.where(second, other, depth)
    for wanted in (first & ~second, second):
        report = Report()
        fit = lambda image, wanted=wanted: 0.02 if np.mean(wanted[image > 0]) > 0.5 else 0.3  # noqa: E731
        found = body_depth(scene, CAMERA, None, report, misfit=fit) > 0
        assert np.count_nonzero(found & wanted) > 0.9 * np.count_nonzero(wanted)
        assert not report.warnings
    with pytest.raises(ValueError, match="no person was found"):
        body_depth(scene, CAMERA, misfit=lambda image: 0.3)


def test_planes_are_those_of_the_room(standing):
    room = Room(tilt=0.2, roll=0.05)
    depth, _ = seen(standing, room)
    planes = find_planes(depth, CAMERA)
    for normal, offset in (([0, 1, 0], 0), ([0, 0, -1], -3.5)):  # floor, the wall behind
        expected = np.array(normal, float) @ room.world_from_camera
        distance = offset - np.dot(normal, [0, room.height_m, 0])
        errors = np.abs(planes.normals - expected).max(1) + np.abs(planes.offsets - distance)
        assert errors.min() < 0.02


@pytest.mark.slow
def test_what_is_found_in_random_rooms_is_hardly_ever_wrong_without_a_doubt():
    from collections import Counter

    from ljn.pipeline.pipeline import Pipeline
    from tests.benchmarks.scene_checks import outcome_of
    from tests.rooms import scenes

    pipeline = Pipeline.from_pretrained()
    counts = Counter(outcome_of(scene, pipeline) for scene in scenes(60, seed=3))
    assert counts["wrong"] <= 2
    assert counts["found"] + counts["found, doubted"] >= 36
