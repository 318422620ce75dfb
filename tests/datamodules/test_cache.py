import json
import multiprocessing
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.cache import cached_records, cached_samples


def make_samples(value=0.5):
    return {"points": torch.full((4, 3, 2), value), "sample_id": torch.arange(4)}


def never():
    raise AssertionError("the set should have been read, not made")


def assert_equal(samples, expected):
    assert set(samples) == set(expected)
    for name, value in expected.items():
        assert samples[name].dtype == value.dtype
        assert torch.equal(samples[name], value)


def test_a_set_is_made_once_and_read_back_equal(tmp_path):
    directory = tmp_path / "not" / "there yet"
    assert_equal(cached_samples(directory, "key", make_samples), make_samples())
    assert_equal(cached_samples(directory, "key", never), make_samples())
    assert [entry.name for entry in directory.iterdir()] == ["key"]
    view = {"points": torch.arange(24.0).view(4, 6).T}  # not contiguous
    assert_equal(cached_samples(directory, "another key", lambda: view), view)
    cached_samples(directory, "key", never)["points"].zero_()
    assert_equal(cached_samples(directory, "key", never), make_samples())


@pytest.mark.parametrize("has_heading", [False, True])
def test_a_table_of_poses_is_made_once_and_read_back_equal(tmp_path, source, has_heading):
    made = replace(source.records("val", 6, seed=1), has_heading=has_heading)
    assert len({len(name) for name in made.sequence}) > 1
    for read in (cached_records(tmp_path, "key", lambda: made), cached_records(tmp_path, "key", never)):
        assert (read.hash, read.has_heading) == (made.hash, has_heading)
        for name in ("pose", "betas", "gender", "sequence", "frame"):
            one, other = getattr(read, name), getattr(made, name)
            assert one.dtype == other.dtype
            assert np.array_equal(one, other), name


@pytest.mark.parametrize(
    "damage",
    [
        lambda place: (place / "points.npy").unlink(),
        lambda place: (place / "points.npy").write_bytes(b""),
        lambda place: (place / "points.npy").write_bytes((place / "points.npy").read_bytes()[:-8]),
        lambda place: (place / "points.npy").write_bytes(b"noise" * 40),
        lambda place: np.save(place / "points.npy", np.zeros((3, 3, 2), np.float32)),
        lambda place: np.save(place / "points.npy", np.zeros((4, 3, 2), np.float32)),
        lambda place: (place / "index.json").unlink(),
        lambda place: (place / "index.json").write_text('{"points": [4'),
    ],
)
def test_a_damaged_set_is_made_anew_with_a_warning(tmp_path, damage):
    cached_samples(tmp_path, "key", make_samples)
    damage(tmp_path / "key")
    with pytest.warns(UserWarning, match=r"samples in .*key are damaged .*; making them anew"):
        samples = cached_samples(tmp_path, "key", lambda: make_samples(2.0))
    assert_equal(samples, make_samples(2.0))
    assert_equal(cached_samples(tmp_path, "key", never), make_samples(2.0))


def test_a_failure_to_make_or_write_the_samples_leaves_nothing(tmp_path, monkeypatch):
    with pytest.raises(AssertionError):
        cached_samples(tmp_path, "key", never)

    def full_disk(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(json, "dumps", full_disk)
    with pytest.raises(OSError, match="No space left"):
        cached_samples(tmp_path, "key", make_samples)
    assert not list(tmp_path.iterdir())


def _make_together(directory, barrier, value, answers):
    def make():
        barrier.wait(30)  # neither has finished before both have begun
        return make_samples(value)

    samples = cached_samples(directory, "key", make)
    answers.put((value, float(samples["points"].mean()), samples["sample_id"].tolist()))


def test_two_processes_at_once_both_get_a_whole_set(tmp_path):
    context = multiprocessing.get_context("fork")
    barrier, answers = context.Barrier(2), context.Queue()
    arguments = [(tmp_path, barrier, value, answers) for value in (0.5, 2.0)]
    workers = [context.Process(target=_make_together, args=args) for args in arguments]
    for worker in workers:
        worker.start()
    got = [answers.get(timeout=30) for _ in workers]
    for worker in workers:
        worker.join(30)
        assert worker.exitcode == 0
    kept = float(cached_samples(tmp_path, "key", never)["points"].mean())
    assert kept in (0.5, 2.0)
    for _, mean, sample_id in got:
        assert mean == kept, "both read the set that was first in its place"
        assert sample_id == [0, 1, 2, 3]
    assert [entry.name for entry in tmp_path.iterdir()] == ["key"], "the second copy is gone"


def _die_while_writing(directory):
    def die(*_, **__):
        os.kill(os.getpid(), signal.SIGKILL)

    json.dumps = die  # after the arrays, before the index
    cached_samples(directory, "key", make_samples)


def test_a_writer_that_is_killed_leaves_no_set_under_the_key(tmp_path):
    writer = multiprocessing.get_context("fork").Process(target=_die_while_writing, args=(tmp_path,))
    writer.start()
    writer.join(30)
    assert writer.exitcode == -signal.SIGKILL
    assert not (tmp_path / "key").exists()
    assert_equal(cached_samples(tmp_path, "key", lambda: make_samples(2.0)), make_samples(2.0))
    assert_equal(cached_samples(tmp_path, "key", never), make_samples(2.0))
