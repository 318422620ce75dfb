"""A benchmark's results as files: CSV, a table in Markdown, one HTML page."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from ljn.report import markup
from ljn.report.page import document, sheet_table
from ljn.report.writers import NONE, Entry, Sheet, markdown_lines, number, text_lines
from ljn.runs import layout
from ljn.runs.files import write_text_atomically

RESULTS, SAMPLES, PAGE = "results.csv", "samples.csv", "index.html"


@dataclass(frozen=True)
class Section:
    """A table with its charts.

    Attributes:
        name: For links.
        title: Its heading.
        sheet: The table.
        charts: HTML figures.
        notes: What is to be known of it, plain text.
    """

    name: str
    title: str
    sheet: Sheet
    charts: Sequence[str] = ()
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Outcome:
    """What a benchmark has found.

    Attributes:
        name: The benchmark's.
        identity: Plain values on which it depends, beside the predictors.
        facts: What a report says of it, by name.
        sections: Tables.
        rows: Of `results.csv`: a row for each predictor and condition.
        samples: Of `samples.csv`: a row for each predictor, condition and sample.
        failures: What went wrong, a message each.
        metrics: Of the call.
    """

    name: str
    identity: Mapping[str, Any]
    facts: Mapping[str, Any]
    sections: Sequence[Section]
    rows: Sequence[Mapping[str, Any]]
    samples: Iterable[Mapping[str, Any]] = ()
    failures: Sequence[str] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)


def entry(value: Any) -> Entry:
    """A cell: a number with one decimal, a dash for none, or words."""
    if value is None:
        return Entry(NONE, "none")
    if isinstance(value, str):
        return Entry(value, "none")
    return Entry(number(value) if isinstance(value, float) else str(value))


def write_outcome(directory: Path, outcome: Outcome, command: str) -> str:
    """Write `results.csv`, `samples.csv`, `table.md` and `index.html`; returns the tables as plain text."""
    directory.mkdir(parents=True, exist_ok=True)
    write_text_atomically(directory / RESULTS, _csv(outcome.rows))
    write_text_atomically(directory / SAMPLES, _csv(outcome.samples))
    write_text_atomically(directory / layout.TABLE_MARKDOWN, _markdown(outcome))
    write_text_atomically(directory / PAGE, _html(outcome, command))
    blocks = ["\n".join(f"{name}: {value}" for name, value in outcome.facts.items())]
    for section in outcome.sections:
        notes = [f"  {note}" for note in section.notes]
        blocks.append("\n".join([section.title, *text_lines(section.sheet), *notes]))
    return "\n\n".join([*blocks, *outcome.failures]) + "\n"


def _csv(rows: Iterable[Mapping[str, Any]]) -> str:
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def _markdown(outcome: Outcome) -> str:
    parts = [f"# {outcome.name}", "\n".join(f"- {name}: {value}" for name, value in outcome.facts.items())]
    for section in outcome.sections:
        parts += [f"## {section.title}", "\n".join(markdown_lines(section.sheet)), "  \n".join(section.notes)]
    parts.append("\n".join(f"- {failure}" for failure in outcome.failures))
    return "\n\n".join(part for part in parts if part) + "\n"


def _html(outcome: Outcome, command: str) -> str:
    parts = []
    for section in outcome.sections:
        notes = "".join(f"<li>{escape(note)}</li>" for note in section.notes)
        content = sheet_table(section.title, section.sheet)
        content += f'<ul class="notes">{notes}</ul>' if notes else ""
        content += f'<div class="charts">{"".join(section.charts)}</div>' if any(section.charts) else ""
        parts.append(markup.section(section.name, section.title, content))
    failed = "".join(f"<li>{escape(failure)}</li>" for failure in outcome.failures)
    links = "".join(
        f'<li><a href="#{escape(section.name, quote=True)}">{escape(section.title)}</a></li>'
        for section in outcome.sections
    )
    header = (
        f'<header><p class="eyebrow">Results of a benchmark</p><h1>{escape(outcome.name)}</h1>'
        f"{markup.facts(outcome.facts)}<pre><code>{escape(command)}</code></pre>"
        f'<ul class="summary">{links}</ul>'
        + (markup.section("failed", "Failed", f"<ul>{failed}</ul>", "alert") if failed else "")
        + "</header>"
    )
    footer = "Millimetres, camera frame, unless a heading says otherwise. docs/benchmark.md says what each number is."
    return document(f"{outcome.name}: results", header, parts, footer)
