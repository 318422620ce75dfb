import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from ljn.benchmark.conditions import BASE
from ljn.benchmark.measures import COLUMNS, measure, summary
from ljn.benchmark.outcome import write_outcome
from ljn.benchmark.predictors import Found, LiftedKeypoints, entrant
from ljn.benchmark.rendered import RenderedBenchmark
from ljn.benchmark.store import Store
from ljn.metrics import apve, mpjpe, mpjpe_procrustes


class Truthful:
    """Knows the truth of the samples, and is off by a given length; reads everything."""

    reads = ("keypoints", "joints", "points")

    def __init__(self, samples, off_m):
        self.samples, self.off_m = samples, off_m
        self.by_camera = {samples.camera(index): index for index in range(len(samples))}

    def __call__(self, frames):
        truth = self.samples.truth([self.by_camera[frame.camera] for frame in frames])
        return truth.joints + np.float32([self.off_m, 0, 0]), truth.vertices + np.float32([0, self.off_m, 0])


def run(samples, directory, *predictors, axes=None, num_axis=4):
    entrants = [entrant(each, f"p{number}", {"number": number}) for number, each in enumerate(predictors)]
    bench = RenderedBenchmark(samples, num_axis=num_axis, axes=axes)
    return bench.run(entrants, Store(directory), lambda words: None)


def rows(outcome, **wanted):
    return [row for row in outcome.rows if all(row[key] == value for key, value in wanted.items())]


def test_the_truth_has_no_error_and_a_shift_has_its_length(samples, tmp_path):
    exact = run(samples, tmp_path / "a", Truthful(samples, 0.0))
    for row in rows(exact, status=""):
        assert row["mpjpe_mean"] == pytest.approx(0, abs=1e-4)
    shifted = run(samples, tmp_path / "b", Truthful(samples, 0.06))
    [row] = rows(shifted, axis="base", keypoints="given")
    assert row["samples"] == 8
    for key, value in (
        *(
            ("mpjpe_mean", 60),
            ("mpjpe_p90", 60),
            ("root_aligned_mean", 0),
            ("procrustes_mean", 0),
            ("under_5cm", 0),
        ),
        *(("under_10cm", 100), ("exchanged", 0), ("pve_mean", 60), ("pve_root_aligned_mean", 60 * 2**0.5)),
    ):
        assert row[key] == pytest.approx(value, abs=1e-2), key


def test_the_measures_are_those_of_the_library(samples):
    rng = np.random.default_rng(0)
    truth = samples.truth(range(8))
    joints = (truth.joints + rng.normal(0, 0.05, truth.joints.shape)).astype(np.float32)
    vertices = (truth.vertices + 0.01).astype(np.float32)
    errors = measure(Found(joints, vertices), truth)
    made, true = torch.from_numpy(joints), torch.from_numpy(truth.joints)
    numbers = summary(errors)
    assert numbers.keys() == {column.key for column in COLUMNS}
    assert numbers["mpjpe_mean"] == pytest.approx(float(mpjpe(made, true).mean()), rel=1e-5)
    assert numbers["mpjpe_median"] == pytest.approx(float(np.median(mpjpe(made, true))), rel=1e-5)
    assert numbers["procrustes_mean"] == pytest.approx(float(mpjpe_procrustes(made, true).mean()), rel=1e-5)
    expected = apve(torch.from_numpy(vertices), torch.from_numpy(truth.vertices)).mean()
    assert numbers["pve_mean"] == pytest.approx(float(expected), rel=1e-5)
    with pytest.raises(ValueError, match="vertices: expected those of the truth's topology"):
        measure(Found(joints, vertices[:, :100]), truth)


def test_every_axis_has_a_row_for_each_value_and_way_of_prediction(samples, tmp_path):
    outcome = run(samples, tmp_path, Truthful(samples, 0.01))
    counted = {}
    for row in outcome.rows:
        counted[row["axis"]] = counted.get(row["axis"], 0) + 1
    assert counted["base"] == 2
    assert counted["keypoint_noise"] == 6
    assert counted["missing"] == counted["joint_noise"] == 5
    assert counted["points"] == 12
    assert counted["occlusion"] == 10
    groups = {row["value"] for row in rows(outcome, axis="distance, m")}
    assert groups <= {"1-2", "2-3", "3-4", "4-5"}
    for axis in ("distance, m", "heading, degrees from facing", "pose"):
        assert sum(row["samples"] for row in rows(outcome, axis=axis, keypoints="none")) == 8
    assert sum(row["samples"] for row in rows(outcome, axis="joints", keypoints="none")) == 8 * 24


def test_what_is_not_read_and_what_is_needed_is_said(samples, tmp_path, standing):
    outcome = run(samples, tmp_path, LiftedKeypoints(), standing)
    statuses = {(row["predictor"], row["axis"], row["keypoints"]): row["status"] for row in outcome.rows}
    assert statuses["lifted keypoints", "base", "none"] == "needs keypoints"
    assert statuses["lifted keypoints", "points", "given"] == "not read"
    assert statuses["lifted keypoints", "missing", "given"] == "needs keypoints"  # of the last: none is left
    assert statuses["middle", "base", "given"] == statuses["middle", "keypoint_noise", "given"] == "not read"
    assert statuses["middle", "base", "none"] == ""
    titles = [section.name for section in outcome.sections]
    assert "points" not in titles
    assert any("points of the cloud" in note for note in outcome.sections[0].notes)


def test_what_was_measured_is_not_measured_again(samples, tmp_path, standing):
    first = run(samples, tmp_path, standing)
    # The base, and the axes' first values with it, are measured once; of an axis four samples.
    assert standing.num_frames == 8 + 4 * 4
    again = run(samples, tmp_path, standing)
    assert standing.num_frames == 8 + 4 * 4
    assert again.rows == first.rows
    fresh = RenderedBenchmark(samples, num_axis=4).run(
        [entrant(standing, "x", {})], Store(tmp_path, reads=False), lambda words: None
    )
    assert standing.num_frames == 2 * (8 + 4 * 4)
    assert [row["mpjpe_mean"] for row in fresh.rows] == [row["mpjpe_mean"] for row in first.rows]
    [damaged, *_] = tmp_path.glob("*.npz")
    damaged.write_bytes(b"PK")
    assert run(samples, tmp_path, standing).rows == first.rows


def test_a_predictor_that_fails_costs_the_others_nothing(samples, tmp_path, standing):
    class Failing:
        name = "failing"

        def __call__(self, frames):
            joints = np.zeros((len(frames), 24, 3))
            joints[[frame.camera == samples.camera(6) for frame in frames]] = np.nan
            return joints

    outcome = run(samples, tmp_path, Failing(), standing, axes=["occlusion"])
    assert outcome.failures == [
        "no keypoints: predictor 'failing', sample 6: joints: 72 values are NaN or infinite"
    ]
    assert rows(outcome, predictor="failing", axis="base", keypoints="none")[0]["status"] == "FAILED"
    assert {
        row["status"] for row in rows(outcome, predictor="failing", axis="occlusion", keypoints="none")
    } == {"not measured"}
    assert all(row["status"] == "" for row in rows(outcome, predictor="middle", keypoints="none"))
    text = write_outcome(tmp_path / "out", outcome, "python run.py task=benchmark")
    assert "FAILED" in text
    assert "sample 6" in (tmp_path / "out" / "index.html").read_text()


def test_files_hold_the_numbers(samples, tmp_path, standing):
    outcome = run(samples, tmp_path / "store", standing, LiftedKeypoints(), axes=["keypoint_noise"])
    text = write_outcome(tmp_path, outcome, "python run.py 'a<b'")
    with (tmp_path / "results.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(outcome.rows)
    with (tmp_path / "samples.csv").open() as file:
        of_samples = [
            row for row in csv.DictReader(file) if row["axis"] == "base" and row["predictor"] == "middle"
        ]
    [base] = [
        row for row in table if row["axis"] == "base" and row["predictor"] == "middle" and row["mpjpe_mean"]
    ]
    mean = np.mean([float(row["mpjpe"]) for row in of_samples])
    assert float(base["mpjpe_mean"]) == pytest.approx(mean, abs=1e-3)
    page = (tmp_path / "index.html").read_text()
    assert "<svg" in page
    assert "a&lt;b" in page
    assert "http" not in page.replace("http-equiv", "")
    assert samples.depth_hash in page
    assert samples.depth_hash in text
    assert f"{float(base['mpjpe_mean']):.1f}" in text


def test_an_axis_or_a_number_that_there_is_not_is_refused(samples):
    with pytest.raises(ValueError, match=r"bench\.axes: expected some of keypoint_noise, .*, got colour"):
        RenderedBenchmark(samples, axes=["colour"])
    with pytest.raises(ValueError, match=r"bench\.num_axis: expected a whole number of 1 or more, got 0"):
        RenderedBenchmark(samples, num_axis=0)


def test_a_condition_says_what_differs_from_the_base():
    assert BASE.changes == {}
    assert replace(BASE, occluded_percent=20.0).changes == {"occluded_percent": 20.0}
    assert BASE.without_keypoints.changes == {"keypoint_noise_px": None}
