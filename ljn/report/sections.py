"""The parts of the page below its tables' numbers: data, pictures and where each number comes from."""

import base64
import io
import warnings
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from ljn.report.results import Results
from ljn.report.tables import NUM_DATA
from ljn.report.writers import NONE
from ljn.runs.sweep import Run

_MAX_PICTURE_PX = 1600
_MISSING = '<span class="word">missing</span>'
_SPLITS = {"train": "train", "val": "validation", "test": "test"}
_COUNTS_NOTE = (
    "Thesis: Table 3.1, SURREAL and the samples taken of it; its validation set is a part of its test set. Ours: the "
    "motion capture that poses are taken and recombined from, where it is known (procedural poses need none); each "
    "sample is a pose and a shape of the split's pool."
)


def text(value: Any) -> str:
    """A value for HTML; the word `missing` for none."""
    return _MISSING if value is None or value == "" else escape(str(value))


def mono(value: Any) -> str:
    """A hash or a name for HTML; the word `missing` for none."""
    return _MISSING if value is None or value == "" else f'<span class="mono">{escape(str(value))}</span>'


def scroll(table: str, label: str) -> str:
    """A table in a box of its own, which scrolls where the page is narrow, also from the keyboard."""
    return f'<div class="scroll" role="region" aria-label="{escape(label, quote=True)}" tabindex="0">{table}</div>'


def data(runs: Sequence[Run]) -> str:
    """Table 3.1 beside our data's counts, and each split's pool; once for runs of equal data."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        if run.data:
            same = [run.data.get(key) for key in ("source", "version", "sizes", "pool", "licence", "bodies")]
            groups.setdefault(repr(same), []).append(run)
    if not groups:
        return f"<p>{_MISSING}: no run left a record of its data.</p>"
    parts = []
    for group in groups.values():
        facts = group[0].data
        bodies = ", ".join(map(str, _dict(facts.get("bodies"))))
        listed = {"source": facts.get("source"), "version": facts.get("version"), "bodies": bodies}
        parts.append(
            '<dl class="facts">'
            + "".join(f"<div><dt>{name}</dt><dd>{text(value)}</dd></div>" for name, value in listed.items())
            + "</dl>"
            + scroll(_counts(group), "Numbers of data")
            + f'<p class="notes">{text(facts.get("licence"))}</p>'
        )
    return "".join(parts) + f'<p class="notes">{_COUNTS_NOTE}</p>'


def _counts(runs: Sequence[Run]) -> str:
    """The table of the counts of runs of equal data; older records do not say what the poses are made from."""
    facts = runs[0].data
    sizes, pool = _dict(facts.get("sizes")), _dict(facts.get("pool"))
    motion = next((found for run in runs if (found := _dict(run.data.get("motion")))), {})
    own = {split: {**_dict(motion.get(split)), "samples": sizes.get(split)} for split in NUM_DATA}
    groups, columns, cells = ["<th></th>"], ["<th></th>"], dict.fromkeys(NUM_DATA, "")
    for name in NUM_DATA["train"]:
        has_own = name == "samples" or any(counts.get(name) is not None for counts in own.values())
        names = ("thesis", "ours") if has_own else ("thesis",)
        groups.append(f'<th scope="colgroup" colspan="{len(names)}"><span>{name}</span></th>')
        columns += [f'<th scope="col">{title}</th>' for title in names]
        for split, counts in own.items():
            cells[split] += _cell(NUM_DATA[split].get(name), "thesis")
            cells[split] += _cell(counts.get(name), "ours") if has_own else ""
    groups.append("<th></th>")
    columns.append('<th scope="col" class="text">hash of the pool of poses</th>')
    rows = "".join(
        f'<tr><th scope="row">{_SPLITS[split]}</th>{row}'
        f'<td class="text">{mono(pool[split]) if pool.get(split) else NONE}</td></tr>'
        for split, row in cells.items()
    )
    return (
        f"<table><caption>{len(runs)} run{'s' * (len(runs) > 1)}</caption>"
        f"<thead><tr>{''.join(groups)}</tr><tr>{''.join(columns)}</tr></thead><tbody>{rows}</tbody></table>"
    )


def _cell(value: Any, style: str) -> str:
    return f'<td class="none">{NONE}</td>' if value is None else f'<td class="{style}">{_count(value)}</td>'


def pictures(results: Results) -> str:
    """The best, median and worst test samples: one page of them for each row, of its first seed."""
    figures: dict[Path, str] = {}
    for table in results.tables:
        for row in table.rows:
            path = next((run.picture for run in row.runs if run.picture is not None), None)
            if path is None or path in figures or row.is_shared:
                continue
            source = embed(path)
            if source is None:
                continue
            name = row.row.experiment or row.label
            alt = escape(f"Best, median and worst test samples of {name}, with their errors", quote=True)
            figures[path] = (
                f'<figure><figcaption>{escape(name)} <span class="sub">{escape(path.parts[-3])}</span></figcaption>'
                f'<div class="shot" role="region" tabindex="0" aria-label="{alt}">'
                f'<img src="{source}" alt="{alt}"></div></figure>'
            )
    if not figures:
        return f"<p>{_MISSING}: no run left a picture.</p>"
    return f'<div class="pictures">{"".join(figures.values())}</div>'


def embed(path: Path) -> str | None:
    """A picture as a data URI, at most 1,600 pixels wide; None, with a warning, for a damaged one."""
    try:
        with Image.open(path, formats=("PNG",)) as opened:
            image = opened.convert("RGB")
    except (OSError, ValueError, SyntaxError) as error:  # Pillow's PNG reader raises SyntaxError
        warnings.warn(f"'{path}' is left out of the report: {error}", stacklevel=2)
        return None
    if image.width > _MAX_PICTURE_PX:
        image = image.resize((_MAX_PICTURE_PX, round(image.height * _MAX_PICTURE_PX / image.width)))
    buffer = io.BytesIO()
    # 256 colours keep thin lines and text sharp, at a third of the size.
    image.quantize(256).save(buffer, "PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def provenance(runs: Sequence[Run]) -> str:
    """A line for each run: what its numbers come from."""
    columns = (
        "run", "seed", "status", "preset", "config", "commit", "data", "bodies", "overrides", "parameters",
        "time", "device", "started", "versions",
    )  # fmt: skip
    head = "".join(f'<th scope="col" class="text">{name}</th>' for name in columns)
    rows = []
    for number, run in enumerate(runs):
        record = run.record
        cells = (
            text(run.seed),
            text(run.status) if run.status == "complete" else f'<span class="word">{run.status}</span>',
            text(record.get("preset")),
            mono(record.get("config_hash")),
            _commit(record),
            _data(run),
            "<br>".join(
                f"{escape(str(name))} {mono(value)}" for name, value in _dict(run.data.get("bodies")).items()
            )
            or _MISSING,
            mono(" ".join(run.overrides)) if run.overrides else "none",
            _count(record.get("num_parameters"))
            if record.get("num_parameters") is not None
            else _trained_by(record),
            _duration(record.get("wall_time_s")),
            text(record.get("device")),
            text(record.get("started")),
            escape(", ".join(f"{key} {value}" for key, value in _dict(record.get("versions")).items()))
            or _MISSING,
        )
        body = "".join(f'<td class="text">{cell}</td>' for cell in cells)
        sub = f'<span class="sub">{escape(run.experiment)}</span>' if run.experiment else ""
        rows.append(f'<tr id="run-{number}"><th scope="row">{mono(run.name)}{sub}</th>{body}</tr>')
    table = (
        f'<table class="wide"><caption>Every number above is the mean over its row\'s runs.</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    )
    return scroll(table, "Runs")


def common(runs: Iterable[Run], key: str) -> str:
    """What all records say under a key; several values one after the other."""
    values = {str(run.record[key]) for run in runs if run.record.get(key) is not None}
    return ", ".join(sorted(values))


def _commit(record: Mapping[str, Any]) -> str:
    commit = record.get("commit")
    if not commit:
        return _MISSING
    dirty = {True: ", with changes", False: ", clean"}.get(record.get("is_dirty"), "")  # type: ignore[arg-type]
    return f"{mono(str(commit)[:10])}{dirty}"


def _data(run: Run) -> str:
    if not run.data:
        return _MISSING
    version = run.data.get("version")
    detector = _dict(run.data.get("detector")).get("hash")
    parts = [
        f"{text(run.data.get('source'))} v{escape(str(version))}"
        if version is not None
        else text(run.data.get("source")),
        mono(run.data.get("fingerprint")),
    ]
    if detector:
        parts.append(f"joints of {mono(detector)}")
    return "<br>".join(parts)


def _trained_by(record: Mapping[str, Any]) -> str:
    """Of an evaluation: whose checkpoint it evaluates."""
    if not record.get("trained_by"):
        return _MISSING
    checkpoint = _dict(record.get("checkpoint"))
    place = f"epoch {text(checkpoint.get('epoch'))}, {mono(checkpoint.get('hash'))}"
    return f"those of {mono(record['trained_by'])}<br>{place}"


def _duration(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return _MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _count(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else text(value)


def _dict(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
