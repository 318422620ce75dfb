"""A finished sweep as tables (CSV, Markdown, LaTeX, plain text) and one HTML page, the thesis's numbers beside ours."""

import os
from dataclasses import dataclass
from pathlib import Path

from ljn.report.page import to_html
from ljn.report.results import Results, read_results
from ljn.report.tables import TABLES
from ljn.report.writers import to_csv, to_latex, to_markdown, to_text
from ljn.runs import layout

__all__ = ["TABLES", "Report", "Results", "read_results", "write_report"]


@dataclass(frozen=True)
class Report:
    """What is to be said of a sweep.

    Attributes:
        text: Its tables, for a terminal, with the failed runs by name.
        has_failed: Whether any of its runs failed or left no result.
        paths: The files that were written.
    """

    text: str
    has_failed: bool
    paths: tuple[Path, ...]


def write_report(directory: Path, is_final: bool = True) -> Report:
    """Write a sweep's tables beside its `sweep.json`: `table.csv`, `table.md`, `table.tex` and `report.html`.

    Runs that failed, and files that are missing or damaged, are named as such and stop nothing.

    Args:
        directory: Holds `sweep.json`.
        is_final: Whether the sweep has ended; before that the page is not written.

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
    paths = []
    for name, content in contents.items():
        path = directory / name
        draft = path.with_name(
            f"{name}.{os.getpid()}.tmp"
        )  # jobs side by side write, each in a process of its own
        draft.write_text(content, encoding="utf-8")
        draft.replace(path)
        paths.append(path)
    return Report(to_text(results), bool(results.lost), tuple(paths))
