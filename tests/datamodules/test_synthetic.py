import errno
import logging
import math
import multiprocessing
import os
import resource
import types
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from lightning.fabric.utilities.data import _set_sampler_epoch

from datamodules.batches import BLOCK, EpochSampler, RepeatedBatches
from datamodules.placement import place
from datamodules.sources import SPLITS
from datamodules.sources.embedded import EmbeddedSource
from datamodules.sources.embedded.source import FAMILY_SHARES
from datamodules.synthesis import SynthesisSettings, concatenate
from ljn.body import SMPL
from ljn.body.skeleton import ROOT
from ljn.cloud.lifting import lift_keypoints
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import project, transfer
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotvec_to_rotmat
from ljn.modules.keypoint_detector import KeypointDetector
from ljn.nets.cpn import CascadedPyramidNetwork
from ljn.nets.resnet import ResNet


@pytest.fixture(scope="module")
def train_loader(make_datamodule, tmp_path_factory):
    """Builds a data module's loader of training samples; their validation sample is rendered but once."""
    cache_dir = tmp_path_factory.mktemp("validation")

    def make(takes=("points", "initial_joints"), **changes):
        datamodule = make_datamodule(num_val=1, cache_dir=cache_dir, **changes)
        datamodule.takes = takes
        datamodule.setup("fit")
        return datamodule.train_dataloader()

    return make


def assert_same_bits(one, other):
    assert set(one) == set(other)
    for name in one:
        assert torch.equal(one[name], other[name]), name


def val_set(datamodule):
    datamodule.prepare_data()
    datamodule.setup("validate")
    return concatenate(datamodule.val_dataloader(), datamodule.sizes["val"])


def batches_of(loader, epoch, number=2):
    _set_sampler_epoch(loader, epoch)  # as the trainer does before each epoch
    batches = iter(loader)
    return [next(batches) for _ in range(number)]


# Fixed sets


def test_validation_sets_are_the_same_bits_for_any_number_of_workers_batch_size_and_threads(make_datamodule):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        expected = val_set(make_datamodule())
        torch.set_num_threads(1)
        for changes in ({"num_workers": 1, "batch_size": 3}, {"num_workers": 2}):
            assert_same_bits(val_set(make_datamodule(**changes)), expected)
    finally:
        torch.set_num_threads(threads)
    assert expected["sample_id"].tolist() == list(range(20))


def test_validation_sets_depend_on_neither_the_training_seed_nor_its_size(make_datamodule):
    sets = [val_set(make_datamodule(num_val=4, **changes)) for changes in ({}, {"seed": 5, "num_train": 50})]
    assert_same_bits(*sets)


def test_a_smaller_validation_set_shares_its_draws_with_a_larger_one(make_datamodule):
    # The same placement and noise for the same index; the records are drawn for the whole set.
    few, many = (val_set(make_datamodule(num_val=number)) for number in (4, 6))
    noises = [s["keypoints"][:4] - s["true_keypoints"][:4] for s in (few, many)]
    assert (noises[0] - noises[1]).abs().median() < 1e-3


def test_a_fixed_set_is_rendered_once_and_shared_by_data_modules_that_want_the_same(
    make_datamodule, tmp_path, caplog
):
    with caplog.at_level(logging.INFO, "datamodules"):
        first = val_set(make_datamodule(num_val=4, cache_dir=tmp_path))
        assert "rendering 4 val samples" in caplog.text
        caplog.clear()
        assert_same_bits(val_set(make_datamodule(num_val=4, cache_dir=tmp_path, num_train=99)), first)
        assert "rendering" not in caplog.text


def test_poses_are_made_once_and_shared_by_data_modules_that_want_the_same(make_datamodule, tmp_path, caplog):
    def hashes(**changes):
        caplog.clear()
        return make_datamodule(num_train=4, cache_dir=tmp_path, **changes).describe(("train",))["pool"]

    with caplog.at_level(logging.INFO, "datamodules"):
        first = hashes()
        assert "making 4 train poses" in caplog.text
        assert hashes(seed=1, num_val=1, reuse=2) == first
        assert "making" not in caplog.text
        changes = [{"pool_seed": 1}, {"source": EmbeddedSource(jitter_deg=3.0)}]
        assert len({first["train"], *(hashes(**change)["train"] for change in changes)}) == 3


def test_rendering_a_fixed_set_draws_no_global_random_numbers(make_datamodule):
    before = torch.get_rng_state()
    make_datamodule(num_val=1).setup("validate")
    assert torch.equal(torch.get_rng_state(), before)


def test_the_test_set_is_another_than_the_validation_set(make_datamodule):
    datamodule = make_datamodule(num_val=8, num_test=8)
    datamodule.setup("validate")
    datamodule.setup("test")
    (val,), (test,) = datamodule.val_dataloader(), datamodule.test_dataloader()
    assert (val["betas"] != test["betas"]).any(1).all()
    assert (val["keypoints"] - val["true_keypoints"] != test["keypoints"] - test["true_keypoints"]).any()


def test_what_goes_into_records_has_the_motion_capture_of_each_split_that_is_read(make_datamodule, source):
    datamodule = make_datamodule(num_train=2, num_val=2, num_test=2)
    assert datamodule.describe()["motion"] == {split: source.motion(split) for split in SPLITS}
    assert datamodule.describe(("test",))["motion"] == {"test": {"clips": 5, "frames": 1238}}


# Another value of every field of the settings objects; a new field fails the test until it stands here.
OTHER = {
    "heading": "uniform", "distance_m": (1.5, 2.5), "margin_px": 9.0, "depth_noise_m": 0.002, "keypoint_noise_px": 5.0,
    "missing_keypoints": (0, 0.5), "focal_factors": (0.9, 1.1), "pixel_factors": (0.9, 1.1),
    "initial_joints": "noised", "joint_noise_m": 0.01, "joint_noise": "isotropic", "renderer": "zbuffer",
    "num_points": 33, "normals": "knn", "crop_px": 64, "spacing_m": 0.01,
    "fx": 360.0, "fy": 360.0, "cx": 200.0, "cy": 250.0, "width": 420, "height": 500,
}  # fmt: skip


def test_the_key_of_a_fixed_set_follows_everything_that_it_depends_on(make_datamodule, kinect):
    changes = [
        {"num_val": 21},
        {"pool_seed": 1},
        {"eval_seed": 1},
        {"source": EmbeddedSource(jitter_deg=3.0)},
    ]
    for settings in (SynthesisSettings, ObservationRecipe):
        changes += [{field.name: OTHER[field.name]} for field in fields(settings)]
    changes += [{"camera": replace(kinect, **{field.name: OTHER[field.name]})} for field in fields(kinect)]
    keys = [make_datamodule(**change).fixed_key("val") for change in ({}, *changes)]
    keys.append(make_datamodule().fixed_key("test"))
    image = make_datamodule()
    image.takes = ("crop", "crop_camera")
    keys.append(image.fixed_key("val"))
    assert len(set(keys)) == len(keys)


def test_the_key_of_a_fixed_set_does_not_follow_what_leaves_the_samples_alone(make_datamodule, tmp_path):
    same = {"seed": 1, "num_train": 9, "reuse": 2, "batch_size": 2, "num_workers": 2, "cache_dir": tmp_path}
    changes = [{}, *({name: value} for name, value in same.items())]
    assert len({make_datamodule(**change).fixed_key("val") for change in changes}) == 1


# Training


def test_training_batches_are_the_same_bits_with_and_without_a_worker(train_loader):
    threads = torch.get_num_threads()
    loaders = [train_loader(num_train=16, num_workers=num_workers) for num_workers in (0, 1)]
    try:
        torch.set_num_threads(2)
        for epoch in (0, 1, 1):  # the worker lives on through the epochs
            for plain, worked in zip(*(batches_of(loader, epoch) for loader in loaders)):
                assert_same_bits(plain, worked)
                # A small /dev/shm would fill up, and the batch be lost.
                assert not any(value.is_shared() for value in worked.values())
    finally:
        torch.set_num_threads(threads)


def test_epochs_differ_in_order_and_draws_and_a_resumed_epoch_equals_a_reached_one(train_loader):
    loader = train_loader(num_train=8, batch_size=8)
    epochs = [batches_of(loader, epoch, number=1)[0] for epoch in range(3)]
    resumed = train_loader(num_train=8, batch_size=8)
    assert_same_bits(batches_of(resumed, 2, number=1)[0], epochs[2])

    one, other = epochs[:2]
    assert sorted(one["sample_id"].tolist()) == sorted(other["sample_id"].tolist()) == list(range(8))
    assert one["sample_id"].tolist() != other["sample_id"].tolist()
    one, other = ({name: b[name][b["sample_id"].argsort()] for name in b} for b in (one, other))
    assert torch.equal(one["betas"], other["betas"])
    for name in ("points", "joints", "keypoints"):
        assert (one[name] != other[name]).flatten(1).any(1).all(), name


@pytest.mark.parametrize(("seed", "pool_seed"), [(1, 0), (0, 1)])
def test_training_follows_both_of_its_seeds(train_loader, seed, pool_seed):
    batches = []
    for seeds in ({}, {"seed": seed, "pool_seed": pool_seed}):
        (batch,) = batches_of(train_loader(num_train=4, batch_size=4, **seeds), 0, number=1)
        batches.append({name: batch[name][batch["sample_id"].argsort()] for name in batch})
    assert torch.equal(batches[0]["betas"], batches[1]["betas"]) == (pool_seed == 0)
    noises = [b["keypoints"] - b["true_keypoints"] for b in batches]
    assert ((noises[0] - noises[1]).abs().median() < 1e-3) == (seed == 0)


def test_the_last_incomplete_training_batch_is_dropped_but_not_the_only_one(train_loader):
    for num_train, batch_size, expected in ((40, 16, 2), (40, 64, 1), (40, 40, 1)):
        assert len(train_loader(num_train=num_train, batch_size=batch_size)) == expected


def test_the_sampler_gives_every_index_once_with_its_epoch():
    sampler = EpochSampler(50, seed=3)
    orders = []
    for epoch in (0, 1, 7):
        sampler.set_epoch(epoch)
        epochs, indices = zip(*sampler)
        assert set(epochs) == {epoch}
        assert sorted(indices) == list(range(50))
        orders.append(indices)
    assert len(set(orders)) == 3
    assert len(sampler) == 50


# Renders that are used again


@pytest.mark.parametrize(("num_batches", "times"), [(60, 2), (60, 4), (24, 2), (25, 3), (7, 2), (1, 5)])
def test_batches_come_again_in_blocks_and_no_sooner(num_batches, times):
    plain = [[(0, 2 * i), (0, 2 * i + 1)] for i in range(num_batches)]
    repeated = list(RepeatedBatches(plain, times))
    assert len(repeated) == num_batches == len(RepeatedBatches(plain, times))
    assert repeated[:BLOCK] == [[(*key, 0) for key in batch] for batch in plain[:BLOCK]]
    assert len({key for batch in repeated for key in batch}) == 2 * num_batches
    seen = {}
    for position, batch in enumerate(repeated):
        rendered, (use,) = tuple(key[:2] for key in batch), {key[2] for key in batch}
        assert list(rendered) in plain
        last, its_use = seen.get(rendered, (position - BLOCK, use - 1))
        assert (position - last, use - its_use) == (BLOCK, 1)
        seen[rendered] = position, use
    assert len(seen) <= num_batches / times + BLOCK


def test_the_first_uses_are_the_samples_of_a_training_that_uses_each_once(train_loader):
    given = {"num_train": 60, "batch_size": 2, "num_points": 4}
    plain, twice = (list(train_loader(**given, reuse=reuse)) for reuse in (None, 2))
    assert len(plain) == len(twice) == 30
    for one, other in zip(plain[:BLOCK], twice):
        assert_same_bits(one, other)
    for one, other in zip(plain[:BLOCK], twice[BLOCK:]):
        assert torch.equal(one["sample_id"], other["sample_id"])
        assert torch.equal(one["betas"], other["betas"])
        for name in ("points", "joints", "keypoints", "initial_joints"):
            assert (one[name] != other[name]).flatten(1).any(1).all(), name
    for one, other in zip(plain[BLOCK:], twice[2 * BLOCK :]):
        assert_same_bits(one, other)


@pytest.mark.filterwarnings("ignore:This DataLoader will create 5 worker processes")
@pytest.mark.parametrize("num_workers", [1, 2, 5])
def test_reused_batches_are_the_same_bits_for_any_number_of_workers_and_in_a_resumed_epoch(
    train_loader, num_workers
):
    given = {"num_train": 56, "batch_size": 2, "num_points": 4, "reuse": 2, "takes": ("points", "crop")}
    loader, other = (train_loader(**given, num_workers=number) for number in (0, num_workers))
    batches_of(loader, 0, number=1)
    for one, another in zip(*(batches_of(each, 1, number=28) for each in (loader, other))):
        assert_same_bits(one, another)


@pytest.mark.parametrize("num_workers", [0, 1, 3])
def test_a_worker_finds_what_it_has_rendered(make_datamodule, num_workers):
    datamodule = make_datamodule(num_train=60, batch_size=2, num_points=4, reuse=2)
    datamodule.num_workers = num_workers  # played by hand: each of them gets every so-manyth batch
    workers = max(1, num_workers)
    synthesizer = datamodule._synthesizer("train")
    rendered = []
    render = synthesizer._render
    synthesizer._render = lambda keys, with_depth: rendered.append(keys) or render(keys, with_depth)
    batches = RepeatedBatches([[(0, 2 * i), (0, 2 * i + 1)] for i in range(24)], 2)
    mine = list(batches)[::workers]
    for keys in mine:
        synthesizer.batch(keys)
    assert len(rendered) == len(mine) / 2


@pytest.mark.parametrize("reuse", [0, -1, 1.5])
def test_an_impossible_number_of_uses_is_an_error(make_datamodule, reuse):
    with pytest.raises(ValueError, match="reuse: expected a whole number of 1 or more, got"):
        make_datamodule(reuse=reuse)


# The distribution of the samples (section 3.5.2 and the specification of the camera and the placement)


def test_depths_places_and_headings_are_spread_as_specified(train_loader, body_models, kinect):
    stats = pytest.importorskip("scipy.stats", reason="SciPy is not installed")
    layer = SMPL(body_models)
    pixels, headings, depths, shares = [], [], [], []
    for batch in train_loader(num_train=160, batch_size=32, num_points=4):
        output = layer(batch["pose"], batch["betas"], batch["gender"])
        vertices, joints = (points @ CAMERA_FROM_BODY.float().T for points in output)
        meshes = vertices + (batch["joints"] - joints)[:, ROOT, None]
        pixels.append(project(meshes, batch["camera"]))
        forward = rotvec_to_rotmat(batch["pose"][:, :3])[:, :, 2]
        headings.append(torch.atan2(forward[:, 1], forward[:, 0]))
        for mesh in meshes.double().numpy():
            centre = (mesh[:, 2].min() + mesh[:, 2].max()) / 2
            assert 1.5 - 1e-4 < centre < 3.0 + 1e-4
            nearest = centre + place(mesh, kinect, np.zeros(3))[2]
            if nearest < 1.5 + 1e-4:  # this body fits everywhere
                depths.append(centre)
            # Where it stands between the left and the right limit of its depth.
            here = {"distance_m": (centre, centre)}
            left, right = (-place(mesh, kinect, np.array([x, 0.5, 0]), **here)[0] for x in (0, 1))
            if left - right > 0.01:
                shares.append(left / (left - right))

    pixels, away = torch.cat(pixels), torch.cat(headings).abs()
    assert pixels.min() > 8 - 1e-2
    assert pixels[..., 0].max() < kinect.width - 1 - 8 + 1e-2
    assert pixels[..., 1].max() < kinect.height - 1 - 8 + 1e-2
    assert float((away <= math.pi / 4).float().mean()) == pytest.approx(0.62, abs=0.1)
    assert float((away >= 3 * math.pi / 4).float().mean()) == pytest.approx(0.21, abs=0.09)
    assert len(depths) > 100
    assert stats.kstest(depths, stats.uniform(1.5, 1.5).cdf).pvalue > 0.01
    assert len(shares) > 120
    assert stats.kstest(shares, "uniform").pvalue > 0.01


# Checks before anything expensive


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_split_without_samples_is_an_error_at_once(make_datamodule, split):
    with pytest.raises(ValueError, match=f"num_{split}: expected at least 1 sample, got 0"):
        make_datamodule(**{f"num_{split}": 0})


def test_workers_that_the_system_has_no_room_for_are_found_before_anything_is_rendered(
    make_datamodule, monkeypatch
):
    def full():
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(multiprocessing, "Queue", full)
    with pytest.raises(ValueError, match=r"No space left.*data\.num_workers=0.*docker run --shm-size"):
        make_datamodule(num_workers=2).setup("fit")
    make_datamodule(num_val=1).setup("fit")


# Memory


def resident_mb(pid):
    with open(f"/proc/{pid}/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


@pytest.mark.slow
def test_a_workers_memory_does_not_grow(train_loader):
    if not os.path.exists("/proc/self/statm"):
        pytest.skip("needs /proc to read a process's memory")
    batches = iter(train_loader(num_train=2480, batch_size=16, num_points=1024, num_workers=1))
    (worker,) = batches._workers
    for _ in range(30):
        next(batches)
    before = resident_mb(worker.pid)
    for _ in batches:
        after = resident_mb(worker.pid)
    print(f"the worker's memory: {before:.1f} MB after 480 samples, {after:.1f} MB after 2480")
    assert after - before < 50


def test_without_redrawing_every_epoch_shows_the_same_samples_in_another_order(make_datamodule):
    datamodule = make_datamodule(redraw_each_epoch=False)
    datamodule.setup("fit")
    loader = datamodule.train_dataloader()
    epochs = []
    for epoch in (0, 1):
        loader.batch_sampler.sampler.set_epoch(epoch)
        batches = list(loader)
        order = torch.cat([batch["sample_id"] for batch in batches])
        epochs.append((order, torch.cat([batch["points"] for batch in batches])[order.argsort()]))
    assert not torch.equal(epochs[0][0], epochs[1][0])
    positions, normals = zip(*(points.split(3, -1) for _, points in epochs))
    # Other neighbours in a batch round the body's products otherwise; normals magnify it.
    torch.testing.assert_close(*positions, atol=1e-5, rtol=0)
    torch.testing.assert_close(*normals, atol=1e-2, rtol=0)


def test_kinds_of_poses_and_headings_are_those_of_the_samples(make_datamodule):
    module = make_datamodule(num_test=300)
    module.setup("test")
    groups = module.groups("test")
    kinds = set(groups["pose"])
    assert {"clip", "recombined", "walk"} <= kinds <= {"clip", "recombined", *FAMILY_SHARES}
    # 62 % of the headings are within 45 degrees of the camera; bodies turn in their poses, too.
    upright = ~np.isin(groups["pose"], ["lie", "crawl"])
    facing = (groups["heading"][upright] == "facing").mean()
    assert 0.42 < facing < 0.72
    assert 0.1 < (groups["heading"][upright] == "away").mean() < 0.3


def test_a_keypoint_detector_s_keypoints_stand_in_place_of_the_noisy_ones(
    make_datamodule, tmp_path, monkeypatch
):
    torch.manual_seed(0)
    backbone = ResNet(2, "basic", (1, 1, 1, 1), (8, 8, 8, 8), 8, 3)
    module = KeypointDetector(CascadedPyramidNetwork(backbone, "depth", 8, 4)).eval()
    checkpoint = types.SimpleNamespace(file_hash="abc", path=tmp_path / "x.ckpt", recipe=ObservationRecipe())
    monkeypatch.setattr("datamodules.synthetic.load_module", lambda *_: (module, checkpoint))
    takes = ("crop", "crop_camera", "initial_joints", "confidences")
    noisy, found = make_datamodule(), make_datamodule(keypoint_ckpt=tmp_path / "x.ckpt")
    noisy.takes = found.takes = takes
    found.prepare_data()
    assert found.fingerprint != noisy.fingerprint
    assert found.describe(["test"])["keypoint_detector"]["hash"] == "abc"
    (before, _), (after, depth) = (data.examples("test", range(3)) for data in (noisy, found))
    torch.testing.assert_close(after["joints"], before["joints"])
    in_image = transfer(module(before).keypoints, before["crop_camera"], before["camera"])
    torch.testing.assert_close(after["keypoints"], in_image)
    # Lifted in the crop, a pixel of which is some two of the image, as they are in the image.
    lifted = np.stack([lift_keypoints(*each, found.camera) for each in zip(in_image.numpy(), depth.numpy())])
    assert np.median(np.abs(after["initial_joints"].numpy() - lifted)) < 0.01
    assert ((after["confidences"] == 0) | (after["confidences"] >= 0.2)).all()
    with pytest.raises(
        ValueError, match=r"sees crops of 128 px, those of the data have 64; set data.observation.crop"
    ):
        make_datamodule(keypoint_ckpt=tmp_path / "x.ckpt", crop_px=64).prepare_data()
