"""A sweep's results as one HTML page that needs nothing else: no script, no font, no request."""

from collections.abc import Sequence
from html import escape

from ljn.report import sections, writers
from ljn.report.charts import Series, line_chart
from ljn.report.ordering import verdict
from ljn.report.results import Cell, Results, RowResult, TableResult
from ljn.report.style import STYLE
from ljn.runs.sweep import Run

# A page that asks for anything from elsewhere is stopped by the browser.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def to_html(results: Results) -> str:
    """The page.

    Args:
        results: A sweep's tables.
    """
    sweep = results.sweep
    parts = [_header(results)]
    parts += [_table_section(results, table) for table in results.tables]
    parts += [
        f'<section aria-labelledby="data"><h2 id="data">Data</h2>{sections.data(sweep.runs)}</section>',
        '<section aria-labelledby="pictures"><h2 id="pictures">Best, median and worst test samples</h2>'
        f"{sections.pictures(results)}</section>",
        '<section aria-labelledby="runs"><h2 id="runs">Where each number comes from</h2>'
        f"{sections.provenance(sweep.runs)}</section>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(sweep.name)}: results</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + parts[0]
        + "\n<main>\n"
        + "\n".join(parts[1:])
        + "\n</main>\n<footer>Means over seeds ± standard deviation. Thesis: Chang, <cite>3D Human Pose and Shape "
        "Estimation from Point Clouds with Local Joint Network</cite>, National Taiwan University, 2021.</footer>\n"
        "</body>\n</html>\n"
    )


def _header(results: Results) -> str:
    sweep = results.sweep
    done = sum(run.status == "complete" for run in sweep.runs)
    facts = {
        "preset": sweep.preset,
        "runs": f"{done} of {len(sweep.runs)} complete",
        "seeds": ", ".join(map(str, sorted({run.seed for run in sweep.runs if run.seed is not None}))),
        "data": ", ".join(sorted({str(run.data["source"]) for run in sweep.runs if run.data.get("source")})),
        "device": sections.common(sweep.runs, "device"),
        "commit": ", ".join(value[:10] for value in sections.common(sweep.runs, "commit").split(", ")),
    }
    listed = "".join(
        f"<div><dt>{name}</dt><dd>{sections.text(value)}</dd></div>" for name, value in facts.items()
    )
    parts = [
        '<header><p class="eyebrow">Results of a sweep</p>',
        f"<h1>{escape(sweep.name)}</h1>",
        f'<dl class="facts">{listed}</dl>',
        f"<pre><code>{escape(sweep.command)}</code></pre>",
        f'<ul class="summary">{"".join(map(_summary, results.tables))}</ul>',
    ]
    lost = (*results.failed, *results.missing)
    if lost:
        items = "".join(f"<li>{escape(writers.describe_job(run))}</li>" for run in lost)
        parts.append(
            f'<section class="alert" aria-labelledby="failed"><h2 id="failed">Failed and missing runs</h2>'
            f"<ul>{items}</ul></section>"
        )
    return "".join(parts) + "</header>"


def _summary(table: TableResult) -> str:
    done = sum(row.status == "complete" for row in table.rows)
    badges = [(f"{done} of {len(table.rows)} rows", "good" if done == len(table.rows) else "bad")]
    if any(table.has_thesis):
        holds, said = verdict(table.comparisons, sum(table.num_claims))
        style = "" if holds is None else "good" if holds else "bad"
        badges.append((f"ordering {said if table.comparisons else 'not judged'}", style))
    listed = "".join(f'<span class="badge {style}">{escape(said)}</span>' for said, style in badges)
    return f'<li><a href="#{escape(table.table.name)}">{escape(table.table.title)}</a>{listed}</li>'


def _table_section(results: Results, table: TableResult) -> str:
    name = escape(table.table.name, quote=True)
    notes = "".join(f"<li>{escape(note)}</li>" for note in writers.notes(results, table))
    return (
        f'<section aria-labelledby="{name}"><h2 id="{name}">{escape(table.table.title)}</h2>'
        + sections.scroll(_table(table, results.sweep.runs), table.table.title)
        + _order(table)
        + (f'<ul class="notes">{notes}</ul>' if notes else "")
        + f'<div class="charts">{_axis_charts(table)}{_training_chart(table)}</div></section>'
    )


def _table(table: TableResult, runs: Sequence[Run]) -> str:
    groups, columns = ["<th></th>"], ["<th></th>"]
    for column, has_thesis in zip(table.table.columns, table.has_thesis):
        names = writers.headings(column, has_thesis)
        groups.append(
            f'<th scope="colgroup" colspan="{len(names)}"><span>{escape(column.heading)}</span></th>'
        )
        columns += [f'<th scope="col">{name}</th>' for name in names]
    groups.append("<th></th>")
    columns.append('<th scope="col">seeds</th>')
    body = "".join(_row(row, table, runs) for row in table.rows)
    literature = []
    for entry in table.table.literature:
        cells = [f'<th scope="row">{escape(entry.label)}<span class="sub">{escape(entry.source)}</span></th>']
        for column, has_thesis in zip(table.table.columns, table.has_thesis):
            value = f'<td class="thesis">{writers.number(entry.values.get(column.metric))}</td>'
            names = writers.headings(column, has_thesis)
            cells += [value if name == "thesis" else '<td class="none">–</td>' for name in names]
        literature.append(f'<tr>{"".join(cells)}<td class="none">–</td></tr>')
    more = f"<tbody>{''.join(literature)}</tbody>" if literature else ""
    head = f"<thead><tr>{''.join(groups)}</tr><tr>{''.join(columns)}</tr></thead>"
    return f"<table>{head}<tbody>{body}</tbody>{more}</table>"


def _row(row: RowResult, table: TableResult, runs: Sequence[Run]) -> str:
    links = ", ".join(
        f'<a href="#run-{runs.index(run)}">{"run" if run.seed is None else f"seed {run.seed}"}</a>'
        for run in row.runs
    )
    below = "".join(
        f'<span class="sub">{part}</span>' for part in (escape(row.row.experiment or ""), links) if part
    )
    cells = [f'<th scope="row">{escape(row.label)}{below}</th>']
    for cell, has_thesis in zip(row.cells, table.has_thesis):
        entries = {
            "thesis": f'<td class="thesis">{writers.number(cell.thesis)}</td>',
            "ours": _ours(row, cell),
            "difference": f"<td>{writers.NONE if cell.difference is None else _signed(cell.difference)}</td>",
        }
        cells += [entries[name] for name in writers.headings(cell.column, has_thesis)]
    has_values = any(cell.metric for cell in row.cells)
    status = writers.seeds(row) if has_values else writers.NONE
    style = ' class="word"' if row.status != "complete" else ""
    return f"<tr>{''.join(cells)}<td{style}>{escape(status)}</td></tr>"


def _ours(row: RowResult, cell: Cell) -> str:
    if cell.mean is None:
        style = "none" if cell.metric is None else "word"
        return f'<td class="{style}">{writers.ours(row, cell)}</td>'
    spread = "" if cell.sd is None else f' <span class="sd">± {writers.number(cell.sd)}</span>'
    mark = ' <span class="sd">†</span>' if cell.is_substituted else ""
    return f'<td class="ours">{writers.number(cell.mean)}{spread}{mark}</td>'


def _order(table: TableResult) -> str:
    said = writers.describe_order(table)
    text = f'<p class="order">{escape(said)}</p>' if said else ""
    if not table.comparisons:
        return text
    rows = []
    for entry in table.comparisons:
        held = {
            True: '<span class="badge good">holds</span>',
            False: '<span class="badge bad">does not hold</span>',
        }
        before = "next before" if entry.is_adjacent else "before"
        cells = [
            f'<th scope="row">{escape(entry.better)} <span class="sd">{before}</span> {escape(entry.worse)}</th>',
            f'<td class="text">{escape(entry.column.label)}</td>',
            f'<td class="text">{held[entry.holds] if entry.is_claim else writers.NONE}</td>',
            f"<td>{_signed(entry.lead)} {escape(writers.lead_unit(entry))}</td>",
            f"<td>{writers.number(entry.spread)}</td>",
            f"<td>{writers.NONE if entry.interval is None else ' to '.join(map(_signed, entry.interval))}</td>",
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(
        f'<th scope="col"{" class=text" if number < 3 else ""}>{name}</th>'
        for number, name in enumerate(
            ("", "metric", "thesis's order", "lead", "spread over seeds", "95 % over samples")
        )
    )
    body = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    label = f"{len(rows)} comparisons of rows" if len(rows) > 1 else "The comparison of rows"
    return f"{text}<details><summary>{label}</summary>{sections.scroll(body, label)}</details>"


def _signed(value: float) -> str:
    return writers.number(value, is_signed=True).replace("-", "−")


def _axis_charts(table: TableResult) -> str:
    """The metrics over what the table varies: ours with error bars, the thesis dashed."""
    axis = table.table.axis
    if axis is None:
        return ""
    charts = []
    for number, column in enumerate(table.table.columns):
        if column.goal is None:
            continue
        cells = [(row, row.cells[number]) for row in table.rows]
        own = [
            (row.x, cell.mean, cell.sd) for row, cell in cells if row.x is not None and cell.mean is not None
        ]
        thesis = [
            (row.row.x, cell.thesis, None)
            for row, cell in cells
            if row.row.x is not None and cell.thesis is not None
        ]
        series = [
            Series("ours", tuple(sorted(own, key=lambda point: point[0])), 0),
            Series("thesis", tuple(sorted(thesis, key=lambda point: point[0])), 1, is_dashed=True),
        ]
        title = f"{column.label} by {axis.label}"
        if own:
            charts.append(line_chart(series, title, axis.label, column.heading))
    return "".join(charts)


def _training_chart(table: TableResult) -> str:
    """The validation metric by epoch, a line a row: the mean over the seeds that reached the epoch."""
    column = next((column for column in table.table.columns if column.goal), None)
    if column is None:
        return ""
    series = []
    for number, row in enumerate(table.rows):
        metric = row.row.metrics.get(column.metric, column.metric)
        curves = [run.curve(metric) for run in row.runs] if metric and not row.is_shared else []
        epochs = sorted(set().union(*curves))
        points = []
        for epoch in epochs:
            values = [curve[epoch] for curve in curves if epoch in curve]
            points.append((float(epoch), sum(values) / len(values), None))
        if len(points) > 1:
            series.append(Series(row.label, tuple(points), number, has_markers=False))
    return line_chart(series, f"Validation {column.label} while training", "epoch", column.heading)
