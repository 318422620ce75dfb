import json
import re
import statistics

import pytest

from ljn.report import write_report
from ljn.report.results import read_results
from ljn.report.tables import ROOT_ALIGNED_NOTE
from ljn.runs.sweep import read_sweep


def cells(directory, table=0):
    return {row.label: row for row in read_results(directory).tables[table].rows}


def test_mean_and_standard_deviation_are_over_seeds(sweep):
    values = [60.0, 64.0, 71.0]
    for seed, value in enumerate(values):
        sweep.run("detector/proposed", {"mpjpe_eq38": value, "pckh": 50.0}, seed)
    row = cells(sweep.write("table_3_2"))["proposed"]
    cell = row.cells[0]
    assert cell.mean == pytest.approx(65.0)
    assert cell.sd == pytest.approx(statistics.stdev(values))
    assert cell.num_seeds == 3
    assert cell.difference == pytest.approx(65.0 - 24.2)
    assert row.status == "complete"
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    assert cells(sweep.write("table_3_2"))["basic"].cells[0].sd is None, "of one seed"


def test_the_simple_baseline_is_shown_after_moving_the_roots(table_3_2):
    row = cells(table_3_2)["simple baseline, σ = 0"]
    assert [cell.metric for cell in row.cells] == ["mpjpe_root_aligned", "pckh_root_aligned"]
    assert [cell.mean for cell in row.cells] == [100.5, 29.5]


def test_a_row_says_how_many_of_its_runs_failed(sweep):
    for seed in (0, 1):
        sweep.run("detector/basic", {"mpjpe_eq38": 60.0}, seed)
    sweep.job("detector/basic", 2, status="failed", error="ValueError: no")
    sweep.job("detector/proposed", 0, status="failed")
    rows = cells(sweep.write("table_3_2"))
    assert rows["basic"].status == "failed 1 of 3"
    assert rows["basic"].cells[0].num_seeds == 2
    assert rows["proposed"].status == "failed"
    assert rows["proposed without EDM"].status == "missing"


def test_a_failed_run_s_old_metrics_do_not_count(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    sweep.jobs[0]["status"] = "failed"
    assert cells(sweep.write("table_3_2"))["basic"].cells[0].mean is None


@pytest.mark.parametrize("content", [None, "{", '["no object"]', '{"val/mpjpe": 3.0}'])
def test_a_run_without_readable_test_metrics_is_missing(sweep, content):
    path = sweep.run("detector/basic", {"mpjpe_eq38": 60.0}) / "metrics.json"
    path.unlink() if content is None else path.write_text(content)
    results = read_results(sweep.write("table_3_2"))
    assert results.tables[0].rows[0].status == "missing"
    assert [run.status for run in results.lost] == ["missing"]


def test_a_run_that_left_nothing_but_its_record_of_a_failure_is_failed(sweep):
    folder = sweep.run("detector/basic", {}, status="failed", error="OSError: disk full")
    (folder / "metrics.json").unlink()
    (run,) = read_results(sweep.write("table_3_2")).lost
    assert (run.status, run.error) == ("failed", "OSError: disk full")


def test_a_number_that_was_not_finite_is_no_result_to_be_proud_of(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 50.0})
    sweep.run("detector/proposed", {"mpjpe_eq38": None})  # NaN is written as null
    table = read_results(sweep.write("table_3_2")).tables[0]
    assert str(table.rows[2].cells[0].mean) == "nan"
    assert [comparison.holds for comparison in table.comparisons] == [False]


def test_an_experiment_that_ran_with_several_settings_has_a_row_for_each(sweep):
    for number in (512, 1024):
        typed = (f"data.num_test={number}", "num_threads=1")
        sweep.run("detector/basic", {"mpjpe_eq38": number}, overrides=typed)
    rows = cells(sweep.write("table_3_2"))
    assert rows["basic (data.num_test=512)"].cells[0].mean == 512
    assert rows["basic (data.num_test=1024)"].cells[0].mean == 1024


def test_a_free_grid_has_a_row_for_each_setting_that_varies(sweep):
    for seed in (0, 1):
        for edm in ("true", "false"):
            overrides = (f"model.edm={edm}", "data.num_test=512", "preset=smoke")
            sweep.run(None, {"mpjpe": 60 + seed, "pckh": 50.0}, seed, overrides)
    (table,) = read_results(sweep.write()).tables
    assert [row.label for row in table.rows] == ["model.edm=true", "model.edm=false"]
    assert [column.metric for column in table.table.columns] == ["mpjpe", "pckh"]
    assert [row.cells[0].num_seeds for row in table.rows] == [2, 2]


def test_a_grid_of_mesh_regressors_shows_apve_first(sweep):
    sweep.run("mesh/basic", {"apve": 50.0, "mpjpe": 40.0})
    sweep.run("mesh/proposed", {"apve": 40.0, "mpjpe": 30.0})
    (table,) = read_results(sweep.write()).tables
    assert [row.label for row in table.rows] == ["mesh/basic", "mesh/proposed"]
    assert [column.metric for column in table.table.columns] == ["apve", "mpjpe"]


SIMPLE_BASELINE = {"mpjpe": 900.0, "mpjpe_root_aligned": 80.0, "pckh": 1.0, "pckh_root_aligned": 30.0}
PROPOSED = {"mpjpe": 60.0, "mpjpe_root_aligned": 55.0, "pckh": 50.0, "pckh_root_aligned": 52.0}


def test_a_grid_shows_the_simple_baseline_after_moving_the_roots_as_the_thesis_s_tables_do(sweep):
    for seed in (0, 1):
        sweep.run("detector/simple_baseline", SIMPLE_BASELINE, seed, is_root_relative=True)
        sweep.run("detector/proposed", PROPOSED, seed)
    (table,) = read_results(sweep.write()).tables
    assert [[cell.metric for cell in row.cells] for row in table.rows] == [
        ["mpjpe_root_aligned", "pckh_root_aligned"],
        ["mpjpe", "pckh"],
    ]
    assert [[cell.is_substituted for cell in row.cells] for row in table.rows] == [[True] * 2, [False] * 2]
    assert table.table.notes == (ROOT_ALIGNED_NOTE,)
    assert [comparison.lead for comparison in table.comparisons] == [20.0, 20.0]


def test_a_grid_of_both_stages_has_a_table_for_each(sweep):
    sweep.run("mesh/basic", {"apve": 50.0, "mpjpe": 40.0})
    sweep.run("detector/basic", {"mpjpe": 90.0, "pckh": 40.0})
    sweep.run(None, {"apve": 45.0, "mpjpe": 35.0}, overrides=("model.a=1",))
    tables = read_results(sweep.write()).tables
    assert [table.table.name for table in tables] == ["sweep_detector", "sweep_mesh"]
    assert [table.table.title for table in tables] == ["sweep: detector", "sweep: mesh"]
    labels = [[row.label for row in table.rows] for table in tables]
    assert labels == [["detector/basic"], ["mesh/basic", "model.a=1"]]
    metrics = [[column.metric for column in table.table.columns] for table in tables]
    assert metrics == [["mpjpe", "pckh"], ["apve", "mpjpe"]]
    assert all(cell.mean is not None for table in tables for row in table.rows for cell in row.cells)


def test_runs_without_a_record_are_with_other_seeds_of_theirs_or_else_in_the_first_table(sweep):
    sweep.run("mesh/basic", {"apve": 50.0, "mpjpe": 40.0})
    sweep.run("mine", {"mpjpe": 40.0})
    for experiment in ("mesh/single", "mesh/basic", None):
        sweep.job(experiment, seed=1, status="failed")
    tables = read_results(sweep.write()).tables
    rows = [[(row.row.experiment, row.status) for row in table.rows] for table in tables]
    assert rows == [
        [("mine", "complete"), ("mesh/single", "failed"), (None, "failed")],
        [("mesh/basic", "failed 1 of 2")],
    ]


def test_metrics_of_runs_whose_records_say_nothing_of_them_are_all_shown(sweep):
    sweep.run("old", {"mpjpe": 40.0, "pckh": 50.0}, stage=None, headline=None, metrics=None)
    (table,) = read_results(sweep.write()).tables
    columns = [(column.heading, column.goal) for column in table.table.columns]
    assert columns == [("mpjpe", None), ("pckh", None)]
    assert [cell.mean for cell in table.rows[0].cells] == [40.0, 50.0]


def test_a_grid_of_which_nothing_is_left_says_failed(sweep):
    sweep.job("mine", status="failed")
    report = write_report(sweep.write())
    assert re.search(r"^mine +FAILED +0 \(failed\)$", report.text, re.MULTILINE)


def test_runs_that_belong_to_no_table_are_shown_all_the_same(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    sweep.run("detector/mine", {"mpjpe": 55.0})
    tables = read_results(sweep.write("table_3_2")).tables
    assert [table.table.name for table in tables] == ["table_3_2", "other_runs"]
    assert [row.label for row in tables[1].rows] == ["detector/mine"]


def test_the_demonstration_shows_the_initial_joints_error_from_any_finished_run(sweep):
    sweep.job("detector/mean_offset", status="failed")
    sweep.run("detector/ridge", {"mpjpe": 97.0, "pckh": 27.0, "initial_mpjpe": 160.0})
    row = read_results(sweep.write("demo")).tables[0].rows[0]
    assert (row.cells[0].mean, row.cells[1].mean) == (160.0, None)


def test_a_row_s_place_on_the_axis_is_what_its_runs_were_configured_with(sweep):
    sweep.run("detector/half_points", {"mpjpe_eq38": 60.0})  # the configuration says 512
    rows = read_results(sweep.write("table_3_4")).tables[0].rows
    assert [row.x for row in rows] == [512, 4096]


def test_a_run_directory_may_be_relative_to_a_folder_that_holds_the_sweep_s(sweep, tmp_path):
    folder = sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    sweep.jobs[0]["run_dir"] = "runs/run-0"
    (tmp_path / "sweeps").mkdir()
    sweep.directory = tmp_path / "sweeps"
    assert read_sweep(sweep.write("table_3_2")).runs[0].directory == folder


def test_a_job_that_is_there_twice_counts_once(sweep):
    sweep.run("detector/proposed", {"mpjpe_eq38": 60.0})
    sweep.jobs.append(sweep.jobs[0])
    assert len(read_sweep(sweep.write("table_3_2", "table_3_3")).runs) == 1


def test_settings_that_turn_out_to_be_the_same_run_each_keep_their_row(sweep):
    folder = sweep.run(None, {"mpjpe": 60.0}, overrides=("data.num_test=512",))
    sweep.job(None, overrides=("data.num_test=512.0",), run_dir=str(folder))
    sweep.job("detector/cross_0px", run_dir=str(folder), status="failed")
    rows = cells(sweep.write())
    assert rows["data.num_test=512"].cells[0].mean == rows["data.num_test=512.0"].cells[0].mean == 60.0
    assert rows["detector/cross_0px"].status == "failed"


def test_training_curves_go_over_all_attempts_and_leave_the_final_validation_out(sweep):
    folder = sweep.run("detector/proposed", {"mpjpe_eq38": 60.0})
    more = folder / "csv" / "version_1"
    more.mkdir()
    (more / "metrics.csv").write_text(
        "epoch,step,train/loss,val/mpjpe\n2,1,,80\n2,1,0.4,\n3,1,,70\n3,1,0.4,\n4,1,,70\n"
    )
    (run,) = read_sweep(sweep.write("table_3_2")).runs
    assert run.curve("mpjpe") == {1: 95.0, 2: 94.0, 3: 80.0, 4: 70.0}
    assert run.curve("apve") == {}


def test_a_sweep_that_is_not_there_or_damaged_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected a sweep's directory with a sweep\.json"):
        read_sweep(tmp_path)
    for content in ("{", json.dumps({"jobs": 3})):
        (tmp_path / "sweep.json").write_text(content)
        with pytest.raises(ValueError, match="damaged"):
            read_sweep(tmp_path)


def test_an_unknown_table_is_refused_with_the_known_ones(sweep):
    with pytest.raises(ValueError, match=r"expected some of table_3_2, .*, got table_9"):
        read_results(sweep.write("table_9"))
