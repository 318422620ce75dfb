"""A finished sweep as tables (CSV, Markdown, LaTeX, plain text) and one HTML page, the thesis's numbers beside ours."""

from dataclasses import dataclass
from pathlib import Path

from ljn.report.page import to_html
from ljn.report.results import Results, read_results
from ljn.report.tables import TABLES
from ljn.report.writers import to_csv, to_latex, to_markdown, to_text
from ljn.runs import layout
from ljn.runs.files import write_text_atomically

__all__ = ["TABLES", "Report", "Results", "read_results", "write_report"]


@dataclass(frozen=True)
class Report:
    """A sweep's report, written and for a terminal."""

    text: str  # its tables, for a terminal, with the failed runs by name
    has_failed: bool  # whether any of its runs failed or left no result
    paths: tuple[Path, ...]  # of the files that were written


def write_report(directory: Path, is_final: bool = True) -> Report:
    """Write a sweep's tables beside its `sweep.json`: `table.csv`, `table.md`, `table.tex` and `report.html`.

    Runs that failed, and files that are missing or damaged, are named as such and stop nothing. Before the sweep's end
    (`is_final`) the page is not written.

    Raises:
        FileNotFoundError: There is no `sweep.json`.
        ValueError: It is damaged, or names a table that there is not.
    """
    results = read_results(directory)
    contents = {
        layout.TABLE_CSV: to_csv(results),
        layout.TABLE_MARKDOWN: to_markdown(results),
        layout.TABLE_LATEX: to_latex(results),
    }
    if is_final:
        contents[layout.PAGE] = to_html(results)
    for name, content in contents.items():
        write_text_atomically(directory / name, content)
    return Report(to_text(results), bool(results.lost), tuple(directory / name for name in contents))
