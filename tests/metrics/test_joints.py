import json
import math
import multiprocessing

import pytest
import torch
from torch import distributed

from ljn.metrics import JointMetrics, MeshMetrics, SampleMax, functional

SCORES = {
    "mpjpe",
    "mpjpe_eq38",
    "mpjpe_root_aligned",
    "mpjpe_procrustes",
    "pckh",
    "pckh_root_aligned",
    "exchanged",
}
KEYS = SCORES | {"pckh_threshold_mm", "initial_mpjpe", "initial_mean_distance_px", "initial_max_distance_px"}
NUM_SAMPLES = 13


def make_batch(num_samples):
    generator = torch.Generator().manual_seed(0)

    def noise(size):
        return torch.randn(num_samples, 24, size, generator=generator)

    joints, keypoints = 0.3 * noise(3) + 2, 60 * noise(2) + 200
    return {
        "pred_joints": joints + 0.05 * noise(3),
        "joints": joints,
        "initial_joints": joints + 0.08 * noise(3),
        "keypoints": keypoints + 10 * noise(2),
        "true_keypoints": keypoints,
    }


def updated(metrics, batch, sizes):
    start = 0
    for size in sizes:
        metrics.update(**{name: value[start : start + size] for name, value in batch.items()})
        start += size
    return metrics


def values(metrics):
    return {key: value.item() for key, value in metrics.compute().items()}


def test_joint_metrics_are_the_means_and_maximum_of_the_functional_forms():
    batch = make_batch(NUM_SAMPLES)
    pred, joints, initial, noisy, clean = batch.values()
    distances = functional.keypoint_distances_px(noisy, clean)
    expected = {
        **{score: getattr(functional, score)(pred, joints).mean() for score in SCORES},
        "pckh_threshold_mm": functional.pckh_threshold_mm(joints).mean(),
        "initial_mpjpe": functional.mpjpe(initial, joints).mean(),
        "initial_mean_distance_px": distances.mean(),
        "initial_max_distance_px": distances.max(),
    }
    computed = updated(JointMetrics(), batch, [NUM_SAMPLES]).compute()
    assert computed.keys() == expected.keys() == KEYS
    for key, value in computed.items():
        torch.testing.assert_close(value, expected[key], rtol=1e-12, atol=0)


@pytest.mark.parametrize("sizes", [[1] * NUM_SAMPLES, [12, 1], [5, 0, 8]])
def test_result_does_not_depend_on_the_batches(sizes):
    batch = make_batch(NUM_SAMPLES)
    whole = values(updated(JointMetrics(), batch, [NUM_SAMPLES]))
    assert values(updated(JointMetrics(), batch, sizes)) == pytest.approx(whole, rel=1e-12)


def test_metrics_that_agree_on_the_first_batch_stay_separate():
    first, second = make_batch(4), make_batch(7)
    first["pred_joints"] = first["initial_joints"]
    metrics = updated(updated(JointMetrics(), first, [4]), second, [7])
    both = {name: torch.cat([first[name], second[name]]) for name in first}
    assert values(metrics) == pytest.approx(values(updated(JointMetrics(), both, [11])), rel=1e-12)
    assert values(metrics)["mpjpe"] != values(metrics)["initial_mpjpe"]


def test_each_sample_s_values_come_back_and_give_the_metric_again():
    batch, metrics = make_batch(NUM_SAMPLES), JointMetrics("test/")
    samples = metrics.update(**batch)
    assert samples.keys() == KEYS
    distances = functional.keypoint_distances_px(batch["keypoints"], batch["true_keypoints"])
    assert torch.equal(samples["initial_max_distance_px"], distances.amax(1))
    assert torch.equal(samples["pckh"], functional.pckh(batch["pred_joints"], batch["joints"]))
    for key, value in metrics.compute().items():
        of_samples = samples[key.removeprefix("test/")]
        assert (of_samples.shape, of_samples.dtype) == ((NUM_SAMPLES,), torch.float64)
        whole = of_samples.max() if "max" in key else of_samples.mean()
        torch.testing.assert_close(value, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("metrics", [JointMetrics, MeshMetrics])
def test_a_record_has_unit_and_goal_of_each_metric(metrics):
    facts = metrics.describe()
    assert json.loads(json.dumps(facts)) == facts
    assert facts["metrics"].keys() == metrics.table.keys() > set(facts["headline"])
    assert all(facts["metrics"][key]["goal"] for key in facts["headline"])
    assert facts["metrics"]["mpjpe"] == {"unit": "mm", "goal": "min"}
    higher_is_better = {None: None, "min": False, "max": True}
    for key, metric in metrics().items():
        assert metric.higher_is_better is higher_is_better[facts["metrics"][key]["goal"]]


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_no_samples_give_nan():
    assert all(math.isnan(value) for value in values(JointMetrics()).values())


def test_one_nan_prediction_makes_every_score_of_the_prediction_nan():
    batch = make_batch(NUM_SAMPLES)
    batch["pred_joints"][3, 5, 0] = torch.nan
    computed = values(updated(JointMetrics(), batch, [2, 2, 9]))
    assert {key for key, value in computed.items() if math.isnan(value)} == SCORES


def test_a_nan_makes_the_maximum_nan():
    metric = SampleMax("px")
    metric.update(torch.tensor([torch.nan, 1.0]).double())
    metric.update(torch.tensor([2.0]).double())
    assert metric.compute().isnan()


def test_sums_stay_float64_in_a_half_precision_module():
    batch = make_batch(NUM_SAMPLES)
    metrics = updated(JointMetrics().to(torch.float16), batch, [6, 7])
    assert values(metrics) == pytest.approx(values(updated(JointMetrics(), batch, [NUM_SAMPLES])), rel=1e-12)


def compute_together(rank, folder, batch, answers):
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{folder}/init", rank=rank, world_size=2)
    metrics = JointMetrics()
    # Unequal shares, in a different number of batches.
    for rows in ([slice(0, 4), slice(4, 5)], [slice(5, 13)])[rank]:
        metrics.update(**{name: value[rows] for name, value in batch.items()})
    answers.put(values(metrics))
    distributed.destroy_process_group()


@pytest.mark.ddp
def test_two_processes_compute_what_one_does(tmp_path):
    if not distributed.is_gloo_available():
        pytest.skip("this torch build has no gloo backend")
    batch = make_batch(NUM_SAMPLES)
    context = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()
    workers = [
        context.Process(target=compute_together, args=(rank, tmp_path, batch, answers)) for rank in range(2)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
        assert worker.exitcode == 0
    expected = values(updated(JointMetrics(), batch, [NUM_SAMPLES]))
    for _ in workers:
        assert answers.get() == pytest.approx(expected, rel=1e-12)
