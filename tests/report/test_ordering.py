import numpy as np
import pytest

from ljn.report.ordering import paired_bootstrap, verdict
from ljn.report.results import read_results


def comparisons(directory):
    return read_results(directory).tables[0].comparisons


def judged(directory):
    table = read_results(directory).tables[0]
    return verdict(table.comparisons, sum(table.num_claims))


def test_all_pairs_that_the_thesis_orders_and_that_have_results_are_compared(table_3_2):
    found = comparisons(table_3_2)
    assert verdict(found, 12) == (True, "holds in all 12 comparisons")
    assert judged(table_3_2) == (None, "holds in all 12 comparisons; 8 more want a result")
    own = [entry for entry in found if entry.column.label == "MPJPE" and entry.is_adjacent]
    assert [(entry.better, entry.worse) for entry in own] == [
        ("proposed", "proposed without EDM"),
        ("proposed without EDM", "basic"),
        ("basic", "simple baseline, σ = 0"),
    ]


def test_a_wrong_order_does_not_hold(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0, "pckh": 40.0})
    sweep.run("detector/proposed", {"mpjpe_eq38": 70.0, "pckh": 50.0})
    directory = sweep.write("table_3_2")
    assert [(entry.column.label, entry.holds, entry.lead) for entry in comparisons(directory)] == [
        ("MPJPE", False, -10.0),
        ("PCKh", True, 10.0),
    ]
    assert judged(directory) == (False, "does not hold in 1 of 2 comparisons; 18 more want a result")


def test_a_draw_does_not_hold(sweep):
    for name in ("basic", "proposed"):
        sweep.run(f"detector/{name}", {"mpjpe_eq38": 60.0})
    assert not comparisons(sweep.write("table_3_2"))[0].holds


def test_one_row_alone_is_not_judged(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    assert judged(sweep.write("table_3_2"))[0] is None


def test_what_describes_the_input_is_not_compared(sweep):
    for name in ("sigma_0px", "sigma_5px"):
        sweep.run(f"detector/{name}", {"mpjpe_eq38": 60.0, "initial_max_distance_px": 3.0})
    assert {entry.column.label for entry in comparisons(sweep.write("table_3_3"))} == {"MPJPE"}


@pytest.mark.parametrize(("apart", "exceeds"), [(10.0, True), (1.0, False)])
def test_a_lead_is_held_against_its_spread_over_seeds(sweep, apart, exceeds):
    for seed, more in enumerate((-2.0, 2.0)):
        sweep.run("detector/basic", {"mpjpe_eq38": 60 + apart + more}, seed)
        sweep.run("detector/proposed", {"mpjpe_eq38": 60 + more}, seed)
    (entry,) = comparisons(sweep.write("table_3_2"))
    assert entry.lead == pytest.approx(apart)
    assert entry.spread == pytest.approx(4.0)  # the root of two variances of 8
    assert entry.exceeds_spread is exceeds


def test_without_the_thesis_s_numbers_the_best_row_is_compared_with_the_others(sweep):
    for name, value in (("mean_offset", 130.0), ("proposed", 60.0), ("ridge", 90.0)):
        sweep.run(f"detector/{name}", {"mpjpe": value, "initial_mpjpe": 160.0})
    found = comparisons(sweep.write("demo"))
    assert {entry.better for entry in found} == {"proposed"}
    assert not any(entry.is_claim for entry in found)
    assert verdict(found, 0)[0] is None


def test_the_bootstrap_s_interval_covers_a_known_difference_and_is_paired():
    generator = np.random.default_rng(3)
    shared = generator.normal(60, 30, 4000)  # a sample is hard for both
    low, high = paired_bootstrap(shared, shared + generator.normal(2, 1, 4000))
    assert low < 2 < high
    assert high - low == pytest.approx(2 * 1.96 / np.sqrt(4000), rel=0.15)


def test_the_bootstrap_repeats_itself():
    errors = np.random.default_rng(0).normal(size=(2, 50))
    assert paired_bootstrap(*errors) == paired_bootstrap(*errors)


def test_runs_with_the_errors_of_the_same_samples_get_an_interval(sweep):
    errors = np.random.default_rng(1).uniform(20, 90, 300)
    for seed in (0, 1):
        sweep.run("detector/basic", {"mpjpe_eq38": errors.mean() + 5}, seed, errors=errors + 5)
        sweep.run("detector/proposed", {"mpjpe_eq38": errors.mean()}, seed, errors=errors)
    (entry,) = comparisons(sweep.write("table_3_2"))
    assert entry.interval == pytest.approx((5, 5))


def test_samples_that_another_machine_made_are_the_same(sweep):
    errors = np.random.default_rng(1).uniform(20, 90, 30)
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0}, errors=errors + 5)
    path = sweep.run("detector/proposed", {"mpjpe_eq38": 50.0}, errors=errors) / "test_errors.npz"
    with np.load(path) as arrays:
        np.savez(path, **dict(arrays) | {"joints": arrays["joints"] + 5e-6})
    (entry,) = comparisons(sweep.write("table_3_2"))
    assert entry.interval == pytest.approx((5, 5))


def spoil(path):
    content = bytearray(path.read_bytes())
    content[90:100] = b"\xff" * 10  # in the first array's data
    path.write_bytes(content)


def store(path, number=30, **arrays):
    np.savez_compressed(
        path, **{"sample_id": np.arange(number), "joints": np.zeros((number, 24, 3))} | arrays
    )


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.unlink(),
        lambda path: path.write_bytes(b"PK\x03\x04 cut off"),
        lambda path: (store(path, mpjpe_eq38=np.ones(30)), spoil(path)),
        lambda path: store(path, 20, mpjpe_eq38=np.ones(20)),
        lambda path: store(path, joints=np.full((30, 24, 3), 0.1), mpjpe_eq38=np.ones(30)),
        lambda path: store(path, mpjpe_eq38=np.ones(7)),
        lambda path: store(path, apve=np.ones(30)),
    ],
    ids=[
        "no file",
        "no zip file",
        "wrong bytes",
        "fewer samples",
        "other samples",
        "no row a sample",
        "other metric",
    ],
)
def test_without_the_errors_of_the_same_samples_there_is_no_interval(sweep, damage):
    errors = np.random.default_rng(1).uniform(20, 90, 30)
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0}, errors=errors)
    damage(sweep.run("detector/proposed", {"mpjpe_eq38": 50.0}, errors=errors) / "test_errors.npz")
    (entry,) = comparisons(sweep.write("table_3_2"))
    assert entry.interval is None


def test_a_lead_of_what_should_be_high_has_its_interval_on_the_same_side(sweep):
    shares = np.random.default_rng(1).uniform(20, 90, 30)
    facts = {"headline": ["pckh"], "metrics": {"pckh": {"unit": "%", "goal": "max"}}}
    for name, more in (("a", 5), ("b", 0)):
        folder = sweep.run(name, {"pckh": shares.mean() + more}, errors=shares, **facts)
        store(folder / "test_errors.npz", pckh=shares + more)
    (entry,) = comparisons(sweep.write())
    assert (entry.better, entry.lead) == ("a", pytest.approx(5))
    assert entry.interval == pytest.approx((5, 5))
