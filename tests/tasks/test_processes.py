"""One run in several processes (`trainer.devices=2`), compared with the same run in one."""

import csv
import json
import multiprocessing
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from datamodules.batches import EpochSampler, SharedBatches, fixed_batches
from ljn.building import build
from ljn.tasks import processes
from ljn.tasks.processes import (
    check_trains_in_processes,
    claim_gpu,
    is_first_process,
    num_processes,
    process_number,
)
from ljn.tasks.train import train
from ljn.tasks.validation import validate

TWO = ("trainer.devices=2", "trainer.accelerator=cpu", "trainer.strategy=ddp")
RUN = (
    "experiment=detector/proposed",
    "preset=smoke",
    "logger=csv",
    "data.num_workers=0",
    "preset.num_test=13",
)


@pytest.mark.parametrize(
    ("size", "batch_size", "number"), [(16, 8, 2), (13, 8, 2), (3, 2, 2), (3, 8, 3), (100, 8, 4), (9, 8, 4)]
)
def test_processes_share_a_fixed_set_without_repeating_a_sample(size, batch_size, number):
    parts = [fixed_batches(size, batch_size, process, number) for process in range(number)]
    indices = [index for part in parts for batch in part for index in batch]
    assert sorted(indices) == list(range(size))
    # A process that waits for the others in every batch waits for ever where they have fewer.
    assert len({len(part) for part in parts}) == 1
    assert all(batch for part in parts for batch in part)
    assert [len(batch) for batch in fixed_batches(20, 8)] == [8, 8, 4]


def test_the_parts_of_a_training_batch_are_the_batch_of_one_process():
    def parts(process, number):
        sampler = EpochSampler(20, seed=1)
        batches = SharedBatches(torch.utils.data.BatchSampler(sampler, 8, drop_last=True), process, number)
        batches.sampler.set_epoch(3)
        assert len(batches) == 2
        return list(batches)

    for whole, first, second in zip(parts(0, 1), parts(0, 2), parts(1, 2)):
        assert len(first) == len(second) == 4
        assert Counter(whole) == Counter(first + second)


def test_a_data_module_gives_each_process_its_part(make_datamodule):
    seen = {split: [] for split in ("train", "val", "test")}
    for number in range(2):
        datamodule = make_datamodule(num_train=19, num_val=5, num_test=7, batch_size=4)
        progress = SimpleNamespace(current=SimpleNamespace(processed=0))
        fit_loop = SimpleNamespace(epoch_progress=progress)
        datamodule.trainer = SimpleNamespace(global_rank=number, world_size=2, fit_loop=fit_loop)
        datamodule.setup("fit")
        datamodule.setup("test")
        for split, loader in (
            ("train", datamodule.train_dataloader()),
            ("val", datamodule.val_dataloader()),
            ("test", datamodule.test_dataloader()),
        ):
            ids = [batch["sample_id"].tolist() for batch in loader]
            assert max(map(len, ids)) <= 2
            seen[split] += [index for batch in ids for index in batch]
    assert sorted(seen["val"]) == list(range(5))
    assert sorted(seen["test"]) == list(range(7))
    assert len(seen["train"]) == len(set(seen["train"])) == 16  # the incomplete batch is dropped


@pytest.mark.parametrize(
    ("environment", "number"),
    [({}, 0), ({"LOCAL_RANK": "1"}, 1), ({"RANK": "2", "LOCAL_RANK": "0"}, 2), ({"SLURM_PROCID": "3"}, 3)],
)
def test_a_process_knows_its_number_from_what_started_it(environment, number, monkeypatch):
    for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert process_number() == number
    assert is_first_process() == (number == 0)


@pytest.mark.parametrize(("devices", "number"), [(1, 1), ("3", 3), ([1], 1), ([0, 2], 2)])
def test_devices_say_the_number_of_processes(devices, number):
    assert num_processes({"devices": devices}) == number


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["trainer.devices=auto"], r"trainer\.devices: expected a number of devices.*got 'auto'"),
        (["trainer.devices=-1"], r"trainer\.devices: expected a number of devices.*got -1"),
        (["trainer.devices=0"], r"trainer\.devices: expected a number of devices.*got 0"),
        (["trainer.devices=2", "trainer.strategy=fsdp"], r"trainer\.strategy: expected auto or ddp.*'fsdp'"),
        (["trainer.devices=2", "data.batch_size=3"], r"data\.batch_size: .* must be a multiple of 2, got 3"),
        (["trainer.devices=2", "data.num_train=4"], r"data\.num_train: expected at least 8 samples.*got 4"),
        (["trainer.devices=2", "data.num_test=1"], r"data\.num_test: expected at least 2 samples.*got 1"),
    ],
)
def test_what_cannot_run_on_several_devices_is_refused(overrides, message, smoke_config, tmp_path):
    with pytest.raises(ValueError, match=message):
        validate(smoke_config(tmp_path, *overrides))


@pytest.mark.parametrize(
    ("experiment", "message"),
    [("detector/ridge", "in closed form.*use trainer.devices=1"), ("detector/simple_baseline", "normalises")],
)
def test_what_several_processes_would_train_differently_is_refused(
    experiment, message, smoke_config, tmp_path
):
    module = build(smoke_config(tmp_path, f"experiment={experiment}").module)
    check_trains_in_processes(module, 1)
    with pytest.raises(ValueError, match=message):
        check_trains_in_processes(module, 2)


def test_one_of_several_processes_is_refused_for_one_device(smoke_config, tmp_path, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "1")
    with pytest.raises(ValueError, match=r"process 1 of several .* but the run is for one device"):
        validate(smoke_config(tmp_path))


def test_a_sweep_on_several_devices_is_refused(smoke_config, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "is_job_of_sweep", lambda: True)
    with pytest.raises(ValueError, match=r"a job of a sweep uses one device, got 2.*hydra/launcher=parallel"):
        validate(smoke_config(tmp_path, *TWO))


def test_jobs_side_by_side_claim_a_gpu_each(tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    context = multiprocessing.get_context("fork")
    answers = context.Queue()

    def claim(is_over):
        first = claim_gpu(2, tmp_path)
        assert claim_gpu(2, tmp_path) == first
        answers.put(first)
        is_over.wait(30)

    def start():
        is_over = context.Event()
        job = context.Process(target=claim, args=(is_over,))
        job.start()
        return job, is_over, answers.get(timeout=30)

    jobs = [start() for _ in range(3)]  # the third of more jobs than GPUs shares
    assert {number for *_, number in jobs[:2]} == {0, 1}
    assert jobs[2][2] in (0, 1)
    for job, is_over, _ in jobs:
        is_over.set()
        job.join(30)
        assert job.exitcode == 0
    job, is_over, number = start()  # a claim ends with its process
    is_over.set()
    job.join(30)
    assert number == 0


def test_only_a_job_of_a_sweep_on_several_gpus_claims_one(monkeypatch):
    trainer = {"devices": 1, "accelerator": "auto"}
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(processes, "claim_gpu", lambda count: count - 1)
    assert processes.unclaimed_devices(trainer) == {}
    monkeypatch.setattr(processes, "is_job_of_sweep", lambda: True)
    assert processes.unclaimed_devices(trainer) == {"devices": [1]}
    assert processes.unclaimed_devices(trainer | {"accelerator": "cpu"}) == {}
    assert processes.unclaimed_devices(trainer | {"devices": [0]}) == {}


@pytest.fixture(scope="module")
def on_one(smoke_config, tmp_path_factory):
    """The run in one process: its metrics and its directory."""
    directory = tmp_path_factory.mktemp("one")
    metrics = train(smoke_config(directory, "experiment=detector/proposed", "preset.num_test=13"))
    [run_dir] = directory.glob("runs/*")
    return metrics, run_dir


@pytest.fixture(scope="module")
def on_two(run_py, tmp_path_factory):
    """The same in two processes, started as a user does: the finished process and the run's directory."""
    directory = tmp_path_factory.mktemp("two")
    done = run_py(*RUN, *TWO, f"paths.output_dir={directory}")
    [run_dir] = directory.glob("runs/*")
    return done, run_dir


def state(run_dir):
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def losses(run_dir):
    [path] = run_dir.glob("csv/*/metrics.csv")
    with path.open() as file:
        return [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_train_what_one_trains(on_one, on_two):
    (metrics, one), (_, two) = on_one, on_two
    assert two.name == one.name
    assert json.loads((two / "metrics.json").read_text()) == pytest.approx(metrics, rel=1e-4)
    assert losses(two) == pytest.approx(losses(one), rel=1e-5)
    ours, theirs = state(one), state(two)
    for name, value in ours.items():
        torch.testing.assert_close(theirs[name], value, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_write_one_runs_files_and_lines_and_test_every_sample_once(on_one, on_two):
    (_, one), (done, two) = on_one, on_two
    record = json.loads((two / "record.json").read_text())
    assert (record["status"], record["attempts"], record["num_devices"]) == ("complete", 1, 2)
    names = [{str(path.relative_to(directory)) for path in directory.rglob("*")} for directory in (one, two)]
    assert names[0] == names[1]
    for line in ("training in", "epoch 1/2", "epoch 2/2", "test/mpjpe "):
        assert done.stdout.count(line) == 1, done.stdout
    assert "Traceback" not in done.stderr
    with np.load(one / "test_errors.npz") as ours, np.load(two / "test_errors.npz") as theirs:
        assert theirs["sample_id"].tolist() == list(range(13))
        assert set(ours) == set(theirs)
        np.testing.assert_allclose(theirs["mpjpe"], ours["mpjpe"], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.ddp
def test_two_processes_measure_what_one_measures_and_find_its_run_again(on_one, run_py, tmp_path):
    metrics, run_dir = on_one
    checkpoint = run_dir / "checkpoints" / "best.ckpt"
    run_py(*("task=evaluate", f"ckpt_path={checkpoint}", "logger=csv", f"paths.output_dir={tmp_path}", *TWO))
    [path] = tmp_path.glob("evaluations/*/metrics.json")
    expected = {name: value for name, value in metrics.items() if name.startswith("test/")}
    assert json.loads(path.read_text()) == pytest.approx(expected, rel=1e-6)
    with np.load(path.parent / "test_errors.npz") as errors:
        assert errors["sample_id"].tolist() == list(range(13))
    before = (run_dir / "record.json").read_text()
    done = run_py(*RUN, *TWO, f"paths.output_dir={run_dir.parents[1]}")
    assert "is complete" in done.stdout
    assert (run_dir / "record.json").read_text() == before
