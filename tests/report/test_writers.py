import csv
import re

import pytest

from ljn.report import write_report
from ljn.report.writers import latex


def test_the_terminal_s_table_names_what_failed(table_3_2):
    report = write_report(table_3_2)
    (line,) = [line for line in report.text.splitlines() if line.startswith("simple baseline, σ = 10 px")]
    assert line.split()[-7:] == ["FAILED", "–", "33.6", "FAILED", "–", "0", "(failed)"]
    assert (
        "FAILED detector/simple_baseline seed=0: ValueError: <script>alert(1)</script> & more_text"
        in report.text
    )
    assert report.has_failed


def test_the_terminal_s_table_has_means_deviations_and_differences(table_3_2):
    (line,) = [line for line in write_report(table_3_2).text.splitlines() if line.startswith("proposed  ")]
    assert re.split(r"\s{2,}", line) == [
        "proposed", "24.2", "60.5 ± 0.7", "+36.3", "90.8", "54.5 ± 0.7", "-36.3", "2",
    ]  # fmt: skip


def test_a_row_without_runs_is_missing_and_never_blank(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0, "pckh": 50.0})
    report = write_report(sweep.write("table_3_2"))
    (line,) = [line for line in report.text.splitlines() if line.startswith("proposed  ")]
    assert line.split() == ["proposed", "24.2", "missing", "–", "90.8", "missing", "–", "0", "(missing)"]
    assert not report.has_failed


def test_a_finished_run_without_metrics_counts_as_failure(sweep):
    (sweep.run("detector/basic", {"mpjpe_eq38": 60.0}) / "metrics.json").unlink()
    report = write_report(sweep.write("table_3_2"))
    assert report.has_failed
    assert "MISSING run-0: it left no test metrics" in report.text


def test_csv_gives_back_every_number_unrounded(table_3_2):
    write_report(table_3_2)
    with (table_3_2 / "table.csv").open(newline="") as file:
        rows = {(row["row"], row["column"]): row for row in csv.DictReader(file)}
    assert len(rows) == 10
    row = rows["proposed", "MPJPE"]
    assert float(row["mean"]) == 60.5
    assert float(row["sd"]) == pytest.approx(0.5**0.5, abs=1e-15)
    assert (row["num_seeds"], row["thesis"], row["status"], row["unit"]) == ("2", "24.2", "complete", "mm")
    assert float(row["difference"]) == 60.5 - 24.2
    assert [path.rpartition("/")[2] for path in row["run_dirs"].split(";")] == ["run-2", "run-6"]
    failed = rows["simple baseline, σ = 10 px", "PCKh"]
    assert (failed["mean"], failed["status"], failed["num_seeds"]) == ("", "failed", "0")


def test_files_of_a_sweep_with_several_tables_hold_all_of_them(sweep):
    sweep.run("detector/proposed", {"mpjpe_eq38": 60.0, "pckh": 50.0})
    report = write_report(sweep.write("table_3_2", "table_3_3", "table_3_5"))
    for title in ("Table 3.2", "Table 3.3", "Table 3.5"):
        assert title in report.text
        for name in ("table.md", "table.tex", "report.html"):
            assert title in (sweep.directory / name).read_text()
    written = (sweep.directory / "table.csv").read_text()
    assert all(f"{name}," in written for name in ("table_3_2", "table_3_3", "table_3_5"))


def test_before_the_sweep_s_end_there_is_no_page(sweep):
    sweep.run("detector/basic", {"mpjpe_eq38": 60.0})
    report = write_report(sweep.write("table_3_2"), is_final=False)
    assert [path.name for path in report.paths] == ["table.csv", "table.md", "table.tex"]
    assert not (sweep.directory / "report.html").exists()


def test_markdown_tables_are_rectangular_and_escaped(table_3_2):
    write_report(table_3_2)
    text = (table_3_2 / "table.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {9}
    assert r"\<script\>" in text
    assert "<script>" not in text


def test_latex_tables_are_rectangular(sweep):
    sweep.run("mesh/proposed", {"apve": 60.0, "mpjpe_eq38": 50.0})
    write_report(sweep.write("table_3_5"))
    text = (sweep.directory / "table.tex").read_text()
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert {row.count(" & ") for row in rows[1:]} == {7}
    assert rows[0].count(" & ") == 3
    assert text.count("{") == text.count("}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("no_edm & 50 % of #1", r"no\_edm \& 50 \% of \#1"),
        ("a\\b{c}$d^e~f", r"a\textbackslash{}b\{c\}\$d\textasciicircum{}e\textasciitilde{}f"),
        ("σ = 0, 1 ± 2, –", r"$\sigma$ = 0, 1 $\pm$ 2, --"),
        ("<script> | two\nlines", r"\textless{}script\textgreater{} \textbar{} two lines"),
        ("-3.2", "$-$3.2"),
        ("end-to-end", "end-to-end"),
    ],
)
def test_latex_s_special_characters_are_escaped(text, expected):
    assert latex(text) == expected
