import numpy as np
import pytest
import torch

from datamodules.sources.embedded.recombination import (
    LEFT_ARM,
    RIGHT_ARM,
    TRUNK,
    Donors,
    clip_donors,
    jittered,
    swapped_poses,
    whole_poses,
)
from ljn.body.kinematics import SIDES, mirror, without_heading
from ljn.body.skeleton import JOINT_INDEX, MIRROR, NUM_JOINTS, ROOT
from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

LEGS = tuple({*range(NUM_JOINTS)} - {*TRUNK, *LEFT_ARM, *RIGHT_ARM})
PARTS = (LEGS, TRUNK, LEFT_ARM, RIGHT_ARM)


def both(kind):
    return [JOINT_INDEX[f"{side}_{kind}"] for side in SIDES]


def some_rotmat(number, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return rotvec_to_rotmat(
        0.5 * torch.randn(number, NUM_JOINTS, 3, dtype=torch.float64, generator=generator)
    )


def donors_named(prefix, number, seed=0):
    names = np.array([f"{prefix}{index}" for index in range(number)])
    return Donors(some_rotmat(number, seed), names, np.arange(number), np.full(number, 1 / number))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_the_parts_are_the_whole_body_and_mirror_onto_themselves():
    assert sorted([joint for part in PARTS for joint in part]) == list(range(NUM_JOINTS))
    assert sorted(LEGS) == sorted(
        [ROOT, *(joint for kind in ("hip", "knee", "ankle", "foot") for joint in both(kind))]
    )
    for part, mirrored in ((LEGS, LEGS), (TRUNK, TRUNK), (LEFT_ARM, RIGHT_ARM)):
        assert {MIRROR[joint] for joint in part} == set(mirrored)


def test_clip_donors_are_all_frames_and_their_mirror_images_without_heading():
    rotmat, clip = some_rotmat(6), np.array(["b", "a", "a", "a", "a", "b"])
    donors = clip_donors(rotmat, clip)
    expected = torch.cat([rotmat, mirror(rotmat)])
    torch.testing.assert_close(donors.rotmat[:, 1:], expected[:, 1:])
    torch.testing.assert_close(donors.rotmat[:, ROOT], without_heading(expected[:, ROOT]))
    assert donors.name.tolist() == [*"baaaab", *"baaaab"]
    assert donors.frame.tolist() == [0, 0, 1, 2, 3, 1] * 2
    # A clip weighs the square root of its length.
    donors = clip_donors(some_rotmat(125), np.array(["a"] * 25 + ["b"] * 100))
    assert donors.weight.sum() == pytest.approx(1)
    assert donors.weight[donors.name == "b"].sum() == pytest.approx(2 / 3)


def test_donors_are_drawn_by_their_weights(rng):
    donors = Donors(some_rotmat(3), np.array([*"abc"]), np.arange(3), np.array([0.0, 0.75, 0.25]))
    rows = donors.draw(rng, 4000)
    assert np.bincount(rows, minlength=3) / 4000 == pytest.approx([0, 0.75, 0.25], abs=0.03)


def test_whole_poses_are_those_of_the_donor_that_they_name(rng):
    donors = donors_named("", 20)
    made = whole_poses(donors, rng, 50)
    for rotmat, name, frame in zip(*made):
        assert int(name) == frame
        assert torch.equal(rotmat, donors.rotmat[frame])


def test_every_part_comes_from_the_donor_that_the_name_gives(rng):
    donors = donors_named("", 20)
    made = swapped_poses((donors,), 0.0, 0.5, rng, 200)
    apart = 0
    for rotmat, name, frame in zip(*made):
        legs, trunk, left, *right = map(int, name.split("|"))
        assert frame == legs
        apart += len(right)
        for part, donor in zip(PARTS, (legs, trunk, left, right[0] if right else left)):
            assert torch.equal(rotmat[list(part)], donors.rotmat[donor, list(part)])
    assert 70 < apart < 130
    assert len({name.split("|")[0] == name.split("|")[1] for name in made.name.tolist()}) == 2


def test_blended_parts_lie_between_the_two_donors_that_are_named(rng):
    donors = donors_named("", 20)
    made = swapped_poses((donors,), 1.0, 0.0, rng, 100)
    for rotmat, name in zip(made.rotmat, made.name.tolist()):
        assert "+" not in name.split("|")[0]  # legs are never blended
        for part, names in zip((TRUNK, LEFT_ARM), name.split("|")[1:]):
            first, second = (donors.rotmat[int(donor), list(part)] for donor in names.split("+"))
            whole, done, left = (
                rotmat_to_rotvec(a.mT @ b).norm(dim=-1)
                for a, b in ((first, second), (first, rotmat[list(part)]), (rotmat[list(part)], second))
            )
            torch.testing.assert_close(done + left, whole, atol=1e-9, rtol=0)
            if first.equal(second):
                continue
            amounts = done / whole
            torch.testing.assert_close(amounts, amounts[:1].expand_as(amounts), atol=1e-9, rtol=0)


def test_parts_come_from_all_tables(rng):
    made = swapped_poses((donors_named("a", 5), donors_named("b", 5, seed=1)), 0.0, 0.0, rng, 500)
    for part in range(3):
        tables = [name.split("|")[part][0] for name in made.name.tolist()]
        assert np.mean([table == "a" for table in tables]) == pytest.approx(0.5, abs=0.07)


def test_jitter_turns_all_but_the_root_by_its_deviation_and_hinges_less_sideways(rng):
    rotmat = some_rotmat(3000)
    torch.testing.assert_close(jittered(rotmat, 0.0, rng), rotmat)
    moved = rotmat_to_rotvec(rotmat.mT @ jittered(rotmat, 4.0, rng)).rad2deg()
    deviation = moved.std(0)
    assert moved[:, ROOT].abs().max() < 1e-9
    hinges = {joint: axis for name, axis in (("knee", 0), ("elbow", 1)) for joint in both(name)}
    for joint in range(1, NUM_JOINTS):
        for axis in range(3):
            if joint in hinges and axis != hinges[joint]:
                assert deviation[joint, axis] < 2.2
            else:
                assert deviation[joint, axis] == pytest.approx(4, rel=0.08)
