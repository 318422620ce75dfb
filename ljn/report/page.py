"""A sweep's results as one HTML page that needs nothing else: no script, no font, no request."""

from collections.abc import Iterable, Sequence
from html import escape

from ljn.report import markup, sections, writers
from ljn.report.charts import Series, line_chart
from ljn.report.ordering import verdict
from ljn.report.results import Results, TableResult
from ljn.report.style import STYLE
from ljn.runs.sweep import Run

# A page that asks for anything from elsewhere is stopped by the browser.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def to_html(results: Results) -> str:
    """The page."""
    runs = results.sweep.runs
    parts = [
        *(_table_section(results, table) for table in results.tables),
        markup.section("data", "Data", sections.data(runs)),
        markup.section("pictures", "Best, median and worst test samples", sections.pictures(results)),
        markup.section("runs", "Where each number comes from", sections.provenance(runs)),
    ]
    footer = (
        "Means over seeds ± standard deviation. Thesis: Chang, <cite>3D Human Pose and Shape Estimation from Point "
        "Clouds with Local Joint Network</cite>, National Taiwan University, 2021."
    )
    return document(f"{results.sweep.name}: results", _header(results), parts, footer)


def document(title: str, header: str, parts: Iterable[str], footer: str) -> str:
    """A whole page: a title in plain text; header, parts and footer of HTML."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + header
        + "\n<main>\n"
        + "\n".join(parts)
        + f"\n</main>\n<footer>{footer}</footer>\n</body>\n</html>\n"
    )


def _header(results: Results) -> str:
    sweep = results.sweep
    done = sum(run.status == "complete" for run in sweep.runs)
    listed = {
        "preset": sweep.preset,
        "runs": f"{done} of {len(sweep.runs)} complete",
        "seeds": ", ".join(map(str, sorted({run.seed for run in sweep.runs if run.seed is not None}))),
        "data": ", ".join(writers.sources_of(sweep.runs)),
        "device": ", ".join(_recorded(sweep.runs, "device")),
        "commit": ", ".join(value[:10] for value in _recorded(sweep.runs, "commit")),
    }
    lost = "".join(f"<li>{escape(writers.describe_job(run))}</li>" for run in results.lost)
    return (
        f'<header><p class="eyebrow">Results of a sweep</p><h1>{escape(sweep.name)}</h1>{markup.facts(listed)}'
        f"<pre><code>{escape(sweep.command)}</code></pre>"
        f'<ul class="summary">{"".join(map(_summary, results.tables))}</ul>'
        + (markup.section("failed", "Failed and missing runs", f"<ul>{lost}</ul>", "alert") if lost else "")
        + "</header>"
    )


def _recorded(runs: Iterable[Run], key: str) -> list[str]:
    """What the records say under a key."""
    return sorted({str(run.record[key]) for run in runs if run.record.get(key) is not None})


def _summary(table: TableResult) -> str:
    done = sum(row.status == "complete" for row in table.rows)
    badges = [(f"{done} of {len(table.rows)} rows", "good" if done == len(table.rows) else "bad")]
    if any(table.has_thesis):
        holds, words = verdict(table.comparisons, sum(table.num_claims))
        style = "" if holds is None else "good" if holds else "bad"
        badges.append((f"ordering {words if table.comparisons else 'not judged'}", style))
    listed = "".join(f'<span class="badge {style}">{escape(words)}</span>' for words, style in badges)
    return f'<li><a href="#{escape(table.table.name)}">{escape(table.table.title)}</a>{listed}</li>'


def _table_section(results: Results, table: TableResult) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in writers.notes(results, table))
    notes = f'<ul class="notes">{notes}</ul>' if notes else ""
    charts = f'<div class="charts">{_axis_charts(table)}{_training_chart(table)}</div>'
    content = _table(table, results.sweep.runs) + _order(table) + notes + charts
    return markup.section(table.table.name, table.table.title, content)


def _table(table: TableResult, runs: Sequence[Run]) -> str:
    page = writers.sheet(table)
    rows = []
    for row, entries in zip(table.rows, page.rows):
        names = {runs.index(run): "run" if run.seed is None else f"seed {run.seed}" for run in row.runs}
        links = ", ".join(f'<a href="#run-{number}">{name}</a>' for number, name in names.items())
        rows.append(_row(row.label, (escape(row.row.experiment or ""), links), entries))
    literature = [
        _row(entry.label, (escape(entry.source),), entries)
        for entry, entries in zip(table.table.literature, page.rows[len(table.rows) :])
    ]
    return markup.table(table.table.title, _head(page), rows, literature)


def sheet_table(title: str, page: writers.Sheet) -> str:
    """A sheet as a table of its own."""
    rows = [_row(entries[0].text, (), entries) for entries in page.rows]
    return markup.table(title, _head(page), rows)


def _head(page: writers.Sheet) -> list[list[str]]:
    """The headings of a sheet's columns, groups above them where it has some."""
    groups = [markup.group(name, span) if name else _blank(span) for name, span in page.groups]
    columns = [markup.column(name) if name else "<th></th>" for name in page.columns]
    return [groups, columns] if any(name for name, _ in page.groups) else [columns]


def _blank(span: int) -> str:
    return "<th></th>" if span == 1 else f'<th colspan="{span}"></th>'


def _row(label: str, below: Sequence[str], entries: Sequence[writers.Entry]) -> str:
    """A row: its label with what stands below it, HTML, and its cells."""
    subs = "".join(f'<span class="sub">{part}</span>' for part in below if part)
    cells = "".join(_cell(entry) for entry in entries[1:])
    return f'<tr><th scope="row">{escape(label)}{subs}</th>{cells}</tr>'


def _cell(entry: writers.Entry) -> str:
    value, _, more = escape(entry.text).partition(" ")
    if entry.style == "ours" and more:
        return markup.cell(f'{value} <span class="sd">{more}</span>', entry.style)
    return markup.cell(_minus(escape(entry.text)), entry.style)


def _order(table: TableResult) -> str:
    order = writers.describe_order(table)
    text = f'<p class="order">{escape(order)}</p>' if order else ""
    if not table.comparisons:
        return text
    rows = []
    for entry in table.comparisons:
        holds = ("good", "holds") if entry.holds else ("bad", "does not hold")
        badge = f'<span class="badge {holds[0]}">{holds[1]}</span>' if entry.is_claim else writers.NONE
        before = "next before" if entry.is_adjacent else "before"
        interval = " to ".join(map(_signed, entry.interval)) if entry.interval else writers.NONE
        name = f'{escape(entry.better)} <span class="sd">{before}</span> {escape(entry.worse)}'
        lead = f"{_signed(entry.lead)} {escape(writers.lead_unit(entry))}"
        cells = [markup.cell(text, "text") for text in (escape(entry.column.label), badge)]
        cells += map(markup.cell, (lead, writers.number(entry.spread), interval))
        rows.append(f'<tr><th scope="row">{name}</th>{"".join(cells)}</tr>')
    head = [markup.column(name, "text") for name in ("", "metric", "thesis's order")]
    head += [markup.column(name) for name in ("lead", "spread over seeds", "95 % over samples")]
    label = f"{len(rows)} comparisons of rows" if len(rows) > 1 else "The comparison of rows"
    body = markup.table(label, (head,), rows)
    return f"{text}<details><summary>{label}</summary>{body}</details>"


def _signed(value: float) -> str:
    return _minus(writers.number(value, is_signed=True))


def _minus(text: str) -> str:
    return f"−{text[1:]}" if text.startswith("-") else text


def _axis_charts(table: TableResult) -> str:
    """The metrics over what the table varies: ours with error bars, the thesis dashed."""
    axis = table.table.axis
    if axis is None:
        return ""
    charts = []
    for number, shown in enumerate(table.table.columns):
        ours, thesis = [], []
        for row in table.rows:
            cell = row.cells[number]
            if row.x is not None and cell.mean is not None:
                ours.append((row.x, cell.mean, cell.sd))
            if row.row.x is not None and cell.thesis is not None:
                thesis.append((row.row.x, cell.thesis, None))
        if shown.goal and ours:
            series = [Series("ours", tuple(ours), 0), Series("thesis", tuple(thesis), 1, is_dashed=True)]
            charts.append(line_chart(series, f"{shown.label} by {axis.label}", axis.label, shown.heading))
    return "".join(charts)


def _training_chart(table: TableResult) -> str:
    """The validation metric by epoch, a line a row: the mean over the seeds that reached the epoch."""
    shown = next((entry for entry in table.table.columns if entry.goal), None)
    if shown is None:
        return ""
    series = []
    for number, row in enumerate(table.rows):
        metric = row.row.metrics.get(shown.metric, shown.metric)
        curves = [run.curve(metric) for run in row.runs] if metric and not row.is_shared else []
        points = []
        for epoch in sorted(set().union(*curves)):
            values = [curve[epoch] for curve in curves if epoch in curve]
            points.append((float(epoch), sum(values) / len(values), None))
        if len(points) > 1:
            series.append(Series(row.label, tuple(points), number, has_markers=False))
    return line_chart(series, f"Validation {shown.label} while training", "epoch", shown.heading)
