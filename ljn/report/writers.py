"""A sweep's tables as plain text, CSV, Markdown and LaTeX."""

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ljn.report.ordering import Comparison, verdict
from ljn.report.results import Cell, Results, RowResult, TableResult
from ljn.report.tables import Column
from ljn.runs.sweep import Run

NONE = "–"

CSV_FIELDS = (
    "table", "row", "experiment", "overrides", "x", "column", "metric", "unit", "mean", "sd", "num_seeds", "thesis",
    "difference", "status", "run_dirs",
)  # fmt: skip


def number(value: float | None, is_signed: bool = False) -> str:
    """A number with one decimal; a dash for none."""
    if value is None:
        return NONE
    value = round(value, 1) + 0.0  # no negative zero
    return f"{value:+.1f}" if is_signed else f"{value:.1f}"


def headings(column: Column, has_thesis: bool) -> list[str]:
    """What is shown below a column: a difference only of results."""
    return ["thesis", "ours", *["difference"] * bool(column.goal)] if has_thesis else ["ours"]


def lead_unit(comparison: Comparison) -> str:
    """The unit of a difference."""
    return "points" if comparison.column.unit == "%" else comparison.column.unit


def describe_comparison(comparison: Comparison) -> str:
    """A comparison in words."""
    text = f"{comparison.column.label}: {comparison.better} better than {comparison.worse}"
    if comparison.is_adjacent:
        text += ", next to it in the thesis,"
    if comparison.is_claim:
        text += " holds" if comparison.holds else " does not hold"
    text += f", by {number(comparison.lead, is_signed=True)} {lead_unit(comparison)}"
    if comparison.exceeds_spread is not None:
        text += f", {'more' if comparison.exceeds_spread else 'not more'} than the spread over seeds"
        text += f" ({number(comparison.spread)})"
    if comparison.interval is not None:
        low, high = (number(end, is_signed=True) for end in comparison.interval)
        text += f", 95 % interval over test samples {low} to {high}"
    return text


def describe_order(table: TableResult) -> str:
    """The verdict on the thesis's ordering, column by column; of tables without thesis's numbers, nothing."""
    if not any(table.has_thesis):
        return ""
    if not table.comparisons:
        return f"The thesis's ordering: {verdict([], sum(table.num_claims))[1]}."
    parts = []
    for column, num_claims in zip(table.table.columns, table.num_claims):
        if column.goal is not None:
            of_column = [comparison for comparison in table.comparisons if comparison.column is column]
            parts.append(f"{column.label} {verdict(of_column, num_claims)[1]}")
    return "The thesis's ordering: " + "; ".join(parts) + "."


def describe_job(run: Run) -> str:
    """A run that failed or is missing, and why."""
    reason = run.error or ("no error was recorded" if run.status == "failed" else "it left no test metrics")
    return f"{run.status.upper()} {run.name}: {reason}"


def notes(results: Results, table: TableResult) -> list[str]:
    """A table's footnotes."""
    lines = list(table.table.notes)
    sources = sources_of(run for row in table.rows for run in row.runs)
    if any(table.has_thesis) and (results.sweep.preset != "thesis" or sources != ["surreal"]):
        lines.append(
            f"Ours: preset {results.sweep.preset}, data source {' and '.join(sources) or 'missing'}. The thesis: "
            "60,000 training samples of SURREAL. Compare the order of the rows rather than their values."
        )
    return lines


def sources_of(runs: Iterable[Run]) -> list[str]:
    """The names of the data sources of runs."""
    return sorted({str(run.data["source"]) for run in runs if run.data.get("source")})


class Entry(NamedTuple):
    """A cell of a table as text."""

    text: str  # what it says; never nothing
    # its class on the page: `thesis`, `ours`, `none` (a dash) or `word`; none of these for another number
    style: str = ""


@dataclass(frozen=True)
class Sheet:
    """A table's cells as text: what the plain, Markdown, LaTeX and HTML tables have in common."""

    groups: list[tuple[str, int]]  # a heading and how many columns it spans, for each of the table's columns
    columns: list[str]  # second headings, one a column
    rows: list[list[Entry]]  # cells, the row's label first; literature follows our own rows

    @property
    def texts(self) -> list[list[str]]:
        """The rows as text alone."""
        return [[entry.text for entry in row] for row in self.rows]


def sheet(table: TableResult) -> Sheet:
    """A table as text."""
    shown = table.table.columns
    names = [headings(column, has_thesis) for column, has_thesis in zip(shown, table.has_thesis)]
    groups = [(column.heading, len(below)) for column, below in zip(shown, names)]
    none = Entry(NONE, "none")
    rows = []
    for row in table.rows:
        entries = [Entry(row.label)]
        for cell, below in zip(row.cells, names):
            texts = {
                "thesis": Entry(number(cell.thesis), "thesis"),
                "ours": _ours(row, cell),
                "difference": Entry(number(cell.difference, is_signed=True)),
            }
            entries += [texts[name] for name in below]
        rows.append([*entries, _seeds(row) if any(cell.metric for cell in row.cells) else none])
    for literature in table.table.literature:
        entries = [Entry(f"{literature.label} ({literature.source})")]
        for column, below in zip(shown, names):
            value = Entry(number(literature.values.get(column.metric)), "thesis")
            entries += [value if name == "thesis" else none for name in below]
        rows.append([*entries, none])
    columns = [name for below in names for name in below]
    return Sheet([("", 1), *groups, ("", 1)], ["", *columns, "seeds"], rows)


def _ours(row: RowResult, cell: Cell) -> Entry:
    """Our value with its standard deviation over seeds; `failed` or `missing` where there is none."""
    if cell.metric is None:
        return Entry(NONE, "none")
    if cell.mean is None:
        return Entry("FAILED" if row.is_failed else "missing", "word")
    value = number(cell.mean) if cell.sd is None else f"{number(cell.mean)} ± {number(cell.sd)}"
    return Entry(f"{value} †" if cell.is_substituted else value, "ours")


def _seeds(row: RowResult) -> Entry:
    """How many seeds its numbers come from; and its status, where that is not `complete`."""
    count = max((cell.num_seeds for cell in row.cells), default=0)
    return Entry(str(count)) if row.status == "complete" else Entry(f"{count} ({row.status})", "word")


def to_text(results: Results) -> str:
    """Plain tables for the terminal, the failed runs by name below them."""
    parts = [_text_table(results, table) for table in results.tables]
    parts.append("\n".join(map(describe_job, results.lost)))
    return "\n\n".join(part for part in parts if part) + "\n"


def _text_table(results: Results, table: TableResult) -> str:
    title = f"{table.table.title} (preset {results.sweep.preset})"
    lines = [title, *text_lines(sheet(table)), describe_order(table)]
    return "\n".join(lines).removesuffix("\n")


def text_lines(page: Sheet) -> list[str]:
    """A sheet as lines of plain text: its headings, then its rows."""
    widths = [max(map(len, column)) for column in zip(page.columns, *page.texts)]
    start = 0
    heading = []
    for name, span in page.groups:
        below = slice(start, start + span)
        # A heading wider than its columns widens the last of them.
        missing = len(name) - (sum(widths[below]) + 2 * (span - 1))
        widths[start + span - 1] += max(missing, 0)
        heading.append(name.rjust(sum(widths[below]) + 2 * (span - 1)))
        start += span

    def line(texts: Sequence[str]) -> str:
        numbers = (text.rjust(width) for text, width in zip(texts[1:], widths[1:]))
        return "  ".join([texts[0].ljust(widths[0]), *numbers]).rstrip()

    headings = ["  ".join(heading).rstrip()] if any(name for name, _ in page.groups) else []
    return [*headings, *map(line, [page.columns, *page.texts])]


def to_csv(results: Results) -> str:
    """Every number of every table, one a line: unrounded, empty where there is none."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(CSV_FIELDS)
    for table in results.tables:
        for row in table.rows:
            overrides = " ".join(row.runs[0].overrides) if row.runs else None
            directories = ("/".join(run.directory.parts[-2:]) for run in row.runs if run.directory)
            run_dirs = ";".join(directories)
            for cell in row.cells:
                shown = (cell.column.label, cell.metric, cell.column.unit, cell.mean, cell.sd, cell.num_seeds)
                of_row = (table.table.name, row.label, row.row.experiment, overrides, row.x)
                writer.writerow([*of_row, *shown, cell.thesis, cell.difference, row.status, run_dirs])
    return buffer.getvalue()


def to_markdown(results: Results) -> str:
    """The tables in Markdown, with footnotes, orderings and failed runs."""
    parts = [f"# {_markdown(results.sweep.name)}"]
    for table in results.tables:
        parts += [
            f"## {_markdown(table.table.title)}",
            "\n".join(markdown_lines(sheet(table))),
            _markdown(describe_order(table)),
            "\n".join(f"- {_markdown(describe_comparison(entry))}" for entry in table.comparisons),
            "\n".join(_markdown(note) + "  " for note in notes(results, table)).rstrip(),
        ]
    parts.append("\n".join(f"- {_markdown(describe_job(run))}" for run in results.lost))
    return "\n\n".join(part for part in parts if part) + "\n"


def markdown_lines(page: Sheet) -> list[str]:
    """A sheet as the lines of a table in Markdown."""
    groups = [name for name, span in page.groups for _ in range(span)]
    names = [f"{group}: {column}" if group else column for group, column in zip(groups, page.columns)]
    lines = [[_markdown(text) for text in texts] for texts in (names, *page.texts)]
    lines.insert(1, ["---"] + ["---:"] * (len(names) - 1))
    return [f"| {' | '.join(texts)} |" for texts in lines]


def to_latex(results: Results) -> str:
    """The tables in LaTeX, a `table` environment each; they need the package booktabs."""
    return "\n".join(_latex_table(results, table) for table in results.tables)


def _latex_table(results: Results, table: TableResult) -> str:
    page = sheet(table)
    headings, rules, start = [], [], 1
    for name, span in page.groups:
        headings.append(f"\\multicolumn{{{span}}}{{c}}{{{latex(name)}}}" if name else "")
        if name:
            rules.append(f"\\cmidrule(lr){{{start}-{start + span - 1}}}")
        start += span

    def line(texts: Sequence[str], escape: Callable[[str], str] = latex) -> str:
        return "    " + " & ".join(map(escape, texts)) + r" \\"

    body = [line(texts) for texts in page.texts]
    if len(table.rows) < len(body):
        body.insert(len(table.rows), r"    \midrule")
    failed = [describe_job(run) for row in table.rows for run in row.runs if run.status != "complete"]
    remarks = [text for text in (describe_order(table), *notes(results, table), *failed) if text]
    lines = [
        "% needs \\usepackage{booktabs}",
        r"\begin{table}",
        r"  \centering",
        f"  \\caption{{{latex(table.table.title)} (preset {latex(results.sweep.preset)}).}}",
        f"  \\label{{tab:{re.sub(r'[^A-Za-z0-9]+', '-', table.table.name)}}}",
        f"  \\begin{{tabular}}{{l{'r' * (len(page.columns) - 1)}}}",
        r"    \toprule",
        *(line(headings, str), "    " + "".join(rules), line(page.columns)),
        r"    \midrule",
        *body,
        r"    \bottomrule",
        r"  \end{tabular}",
        *(f"  \\par\\smallskip\\footnotesize {latex(remark)}" for remark in remarks),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}", "σ": r"$\sigma$", "±": r"$\pm$",
    "–": "--", "†": r"$\dagger$", "\n": " ", **{character: f"\\{character}" for character in "&%$#_{}"},
})  # fmt: skip


def latex(text: str) -> str:
    """Text with what LaTeX would take for commands escaped; a number's sign becomes a minus."""
    return re.sub(r"^-(?=\d)", "$-$", text.translate(_LATEX))


def _markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>\[\]])", r"\\\1", text.replace("\n", " "))
