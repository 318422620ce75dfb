"""A stage of which nothing in the library knows: 2D keypoints from images."""

import csv
import re
from typing import ClassVar

import lightning.pytorch as lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger
from torch import nn
from torch.utils.data import DataLoader

from ljn.building import build_each
from ljn.metrics import Quantity, StageMetrics, keypoint_distances_px
from ljn.modules.base import StageModule
from ljn.report import read_results, write_report
from ljn.runs import layout
from ljn.runs.files import read_json, write_json
from ljn.runs.record import RunRecord

NUM_KEYPOINTS, SIZE_PX = 3, 8


def share_within_2px(pred, true):
    return 100 * (keypoint_distances_px(pred, true) < 2).double().mean(-1)


class KeypointMetrics(StageMetrics):
    table: ClassVar = {
        "pck": Quantity(share_within_2px, ("pred", "true"), "%", "max"),
        "distance": Quantity(keypoint_distances_px, ("pred", "true"), "px"),
    }
    headline = ("pck", "distance")


class KeypointNet(nn.Sequential):
    takes = ("image",)


class KeypointStage(StageModule):
    stage = "keypoints"
    metrics = KeypointMetrics
    net_type = nn.Sequential
    truth = ("true_keypoints",)
    stored = ("pred_keypoints",)

    def loss(self, batch):
        return (self.predict(batch) - batch["true_keypoints"]).square().mean()

    def evaluate(self, batch, metrics):
        pred = self.predict(batch)
        return {"pred_keypoints": pred, **metrics.update(pred=pred, true=batch["true_keypoints"])}

    def predict(self, batch):
        return self(batch).view(-1, NUM_KEYPOINTS, 2)


class Images(lightning.LightningDataModule):
    """A bright pixel for each keypoint, in a channel of its own."""

    def loader(self, seed):
        generator = torch.Generator().manual_seed(seed)
        places = torch.randint(SIZE_PX, (32, NUM_KEYPOINTS, 2), generator=generator)
        samples = []
        for number, (x, y) in enumerate(zip(places[..., 0], places[..., 1])):
            image = torch.zeros(NUM_KEYPOINTS, SIZE_PX, SIZE_PX)
            image[range(NUM_KEYPOINTS), y, x] = 1
            keypoints = torch.stack([x, y], -1).float()
            samples.append({"image": image, "true_keypoints": keypoints, "sample_id": number})
        return DataLoader(samples, batch_size=8)

    def train_dataloader(self):
        return self.loader(1)

    def val_dataloader(self):
        return self.loader(2)

    def test_dataloader(self):
        return self.loader(3)


@pytest.fixture
def train(compose_config, tmp_path):
    """Train, validate and test with the default callbacks, and leave what a run leaves."""

    def run(name, learning_rate):
        directory = tmp_path / "runs" / name
        cfg = compose_config(
            f"paths.run_dir={directory}", "callbacks.pictures=null", "optimized_metric=val/distance"
        )
        torch.manual_seed(0)
        net = KeypointNet(nn.Flatten(), nn.Linear(NUM_KEYPOINTS * SIZE_PX**2, NUM_KEYPOINTS * 2))
        module = KeypointStage(net, lambda parameters: torch.optim.Adam(parameters, learning_rate))
        trainer = lightning.Trainer(
            max_epochs=20,
            accelerator="cpu",
            callbacks=build_each(cfg.callbacks),
            logger=CSVLogger(directory, "csv"),
            enable_model_summary=False,
            log_every_n_steps=1,
        )
        with RunRecord(directory, {"name": name, **module.describe()}):
            trainer.fit(module, Images())
            trainer.validate(module, Images(), verbose=False)
            metrics = dict(trainer.callback_metrics)
            trainer.test(module, Images(), ckpt_path=directory / layout.BEST_CHECKPOINT, verbose=False)
            metrics |= trainer.callback_metrics
            write_json(directory / layout.METRICS, {key: float(value) for key, value in metrics.items()})
        return directory

    return run


def test_a_stage_of_images_and_keypoints_fits_without_a_special_case(train, tmp_path, capfd):
    runs = {"fast": train("fast", 0.1), "slow": train("slow", 1e-4)}
    assert re.search(
        r"epoch 20/20  loss \d+\.\d{4}  val/distance \d\.\d px  \d+ samples/s", capfd.readouterr().out
    )
    record = read_json(runs["fast"] / layout.RECORD)
    assert (record["status"], record["stage"], record["is_root_relative"]) == ("complete", "keypoints", False)
    assert record["metrics"]["pck"] == {"unit": "%", "goal": "max"}
    with np.load(runs["fast"] / layout.SAMPLES) as arrays:
        assert arrays.keys() == {"sample_id", "pck", "distance", "pred_keypoints", "true_keypoints"}
        means = {key: arrays[key].mean() for key in record["metrics"]}

    job = {"experiment": None, "seed": 0, "status": "complete", "error": None}
    jobs = [
        job | {"overrides": [f"module.optimizer.lr={name}"], "run_dir": str(run)}
        for name, run in runs.items()
    ]
    write_json(tmp_path / layout.SWEEP, {"name": "mine", "preset": "small", "tables": [], "jobs": jobs})
    report = write_report(tmp_path)
    assert not report.has_failed
    with (tmp_path / layout.TABLE_CSV).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["metric"], row["unit"]) for row in rows] == [("pck", "%"), ("distance", "px")] * 2
    for row in rows[:2]:
        assert float(row["mean"]) == pytest.approx(means[row["metric"]], rel=1e-6)
    comparisons = read_results(tmp_path).tables[0].comparisons
    assert [(entry.better, entry.column.goal) for entry in comparisons] == [
        ("module.optimizer.lr=fast", "max"),
        ("module.optimizer.lr=fast", "min"),
    ]
    low, high = comparisons[0].interval
    assert 0 < low < comparisons[0].lead < high
    assert "Validation pck while training" in (tmp_path / layout.PAGE).read_text()
