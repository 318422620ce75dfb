import numpy as np
import pytest
import torch

from datamodules.sources.embedded.families import FAMILIES
from datamodules.sources.embedded.joint_limits import within_limits
from datamodules.sources.embedded.mixture import MixtureSettings, PoseMixture
from datamodules.sources.embedded.source import FAMILY_SHARES, SHARES
from datamodules.sources.penetration import fit_capsules, penetration
from datamodules.sources.reference import REFERENCE_CAPSULES, REFERENCE_OFFSETS
from ljn.body.kinematics import without_heading, world_rotations
from ljn.body.skeleton import ROOT


@pytest.fixture(scope="module")
def make(source, body):
    """Builds a mixture on the validation split's donors."""

    def mixture(**changes):
        settings = {"shares": SHARES, "families": FAMILY_SHARES, "blend_share": 0.3, "apart_share": 0.5}
        settings |= {"jitter_deg": 4.0, "max_penetration_m": 0.05}
        return PoseMixture(MixtureSettings(**{**settings, **changes}), source.mixture.of("val").donors, body)

    return mixture


@pytest.fixture(scope="module")
def drawn(make):
    return make().draw(np.random.default_rng(0), 1500)


def kind_of(name):
    if "|" in name:
        # Parts of a mixed pose may all come from clips by chance.
        return "recombined"
    return "procedural" if name.startswith("proc/") else "whole"


def test_kinds_and_families_come_in_their_shares_after_the_filter(drawn):
    kinds = np.array([kind_of(name) for name in drawn.name])
    total = sum(SHARES.values())
    assert (kinds == "whole").mean() == pytest.approx(SHARES["whole"] / total, abs=0.04)
    assert (kinds == "procedural").mean() == pytest.approx(SHARES["procedural"] / total, abs=0.04)
    families = [name.removeprefix("proc/") for name in drawn.name[kinds == "procedural"]]
    total = sum(FAMILY_SHARES.values())
    for family in FAMILIES:
        expected = pytest.approx(FAMILY_SHARES[family] / total, abs=0.06)
        assert families.count(family) / len(families) == expected


def test_mixed_poses_take_parts_from_clips_and_from_families(make):
    names = make(shares={"mixed": 1}).draw(np.random.default_rng(0), 300).name
    parts = [part for name in names for part in name.split("|")]
    assert np.mean(["proc/" in part.split("+")[0] for part in parts]) == pytest.approx(0.5, abs=0.07)
    assert all(name.count("|") in (2, 3) for name in names)


def test_only_what_has_a_share_is_drawn(make):
    rng = np.random.default_rng(0)
    assert {kind_of(name) for name in make(shares={"whole": 2, "mixed": 0}).draw(rng, 200).name} == {"whole"}
    names = make(shares={"procedural": 1}, families={"sit": 1, "lie": 3}).draw(rng, 400).name.tolist()
    assert set(names) == {"proc/sit", "proc/lie"}
    assert names.count("proc/lie") / 400 == pytest.approx(0.75, abs=0.08)


def test_frames_are_those_of_the_legs_and_minus_one_without_a_clip(drawn, source):
    donors = source.mixture.of("val").donors
    lengths = {name: int(donors.frame[donors.name == name].max()) + 1 for name in np.unique(donors.name)}
    for name, frame in zip(drawn.name, drawn.frame):
        legs = name.split("|")[0]
        assert frame == -1 if legs.startswith("proc/") else 0 <= frame < lengths[legs]


def test_no_pose_reaches_into_itself_by_more_than_the_limit(drawn, body, offsets):
    world = world_rotations(drawn.rotmat)
    assert penetration(world, offsets, fit_capsules(body)).max() <= 0.05
    assert penetration(world, REFERENCE_OFFSETS, REFERENCE_CAPSULES).max() <= 0.05


def test_all_poses_are_within_joint_limits_and_without_heading(drawn):
    torch.testing.assert_close(within_limits(drawn.rotmat), drawn.rotmat, atol=1e-9, rtol=0)
    root = drawn.rotmat[:, ROOT]
    torch.testing.assert_close(without_heading(root), root, atol=1e-9, rtol=0)


def test_the_same_stream_gives_the_same_poses(make, drawn):
    again = make().draw(np.random.default_rng(0), 1500)
    assert torch.equal(again.rotmat, drawn.rotmat)
    assert again.name.tolist() == drawn.name.tolist()
    other = make().draw(np.random.default_rng(1), 1500)
    assert (other.rotmat != drawn.rotmat).flatten(1).any(1).double().mean() > 0.99


def test_the_order_in_which_shares_are_given_does_not_matter(make):
    turned = {name: SHARES[name] for name in reversed(SHARES)}
    families = {name: FAMILY_SHARES[name] for name in reversed(FAMILY_SHARES)}
    one = make().draw(np.random.default_rng(2), 50)
    other = make(shares=turned, families=families).draw(np.random.default_rng(2), 50)
    assert torch.equal(one.rotmat, other.rotmat)


def test_a_limit_that_nothing_meets_is_an_error_that_names_what_failed(make, monkeypatch):
    monkeypatch.setattr("datamodules.sources.embedded.mixture._MAX_ROUNDS", 4)
    mixture = make(shares={"procedural": 1}, families={"sit": 1}, max_penetration_m=0.0)
    mixture.is_clear = lambda rotmat: np.zeros(len(rotmat), bool)
    with pytest.raises(
        ValueError, match=r"max_penetration_m: in 4 tries 3 of 3 poses .*by more than 0.0 m \(proc/sit\)"
    ):
        mixture.draw(np.random.default_rng(0), 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shares": {"whole": 1, "half": 1}}, "shares: expected numbers of 0 or more, .* some of whole, swapped"),
        ({"shares": {}}, "shares: expected numbers of 0 or more, not all 0"),
        ({"families": {"walk": -1, "sit": 2}}, "families: expected numbers of 0 or more, .* some of stand, walk"),
        ({"families": {"walk": 0}}, "families: .*not all 0"),
        ({"blend_share": 1.5}, "blend_share: expected a share from 0 to 1, got 1.5"),
        ({"apart_share": -0.1}, "apart_share: expected a share from 0 to 1, got -0.1"),
        ({"jitter_deg": -1}, "jitter_deg: expected a number of 0 or more, got -1"),
        ({"max_penetration_m": float("nan")}, "max_penetration_m: expected a number of 0 or more, got nan"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(make, changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)
