"""The parts of the page below its tables' numbers: data, pictures and where each number comes from."""

import base64
import io
import warnings
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from ljn.reading import READ_ERRORS
from ljn.report.markup import MISSING, cell, column, facts, group, mono, table, text
from ljn.report.results import Results
from ljn.report.tables import NUM_DATA
from ljn.report.writers import NONE
from ljn.runs.sweep import Run, mapping

_MAX_PICTURE_PX = 1600
_PICTURE_ERRORS: tuple[type[Exception], ...] = (*READ_ERRORS, Image.DecompressionBombError)
_SPLITS = {"train": "train", "val": "validation", "test": "test"}
_COUNTS_NOTE = (
    "Thesis: Table 3.1, SURREAL and the samples taken of it; its validation set is a part of its test set. Ours: the "
    "motion capture that poses are taken and recombined from, where it is known (procedural poses need none); each "
    "sample is a pose and a shape of the split's pool."
)


def data(runs: Sequence[Run]) -> str:
    """Table 3.1 beside our data's counts, and each split's pool; once for runs of equal data."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        if run.data:
            same = [run.data.get(key) for key in ("source", "version", "sizes", "pool", "licence", "bodies")]
            groups.setdefault(repr(same), []).append(run)
    if not groups:
        return f"<p>{MISSING}: no run left a record of its data.</p>"
    parts = []
    for same_data in groups.values():
        about = same_data[0].data
        bodies = ", ".join(map(str, mapping(about.get("bodies"))))
        listed = {"source": about.get("source"), "version": about.get("version"), "bodies": bodies}
        licence = text(about.get("licence"))
        parts.append(f'{facts(listed)}{_counts(same_data)}<p class="notes">{licence}</p>')
    return "".join(parts) + f'<p class="notes">{_COUNTS_NOTE}</p>'


def _counts(runs: Sequence[Run]) -> str:
    """The table of the counts of runs of equal data; older records do not say what the poses are made from."""
    about = runs[0].data
    sizes, pool = mapping(about.get("sizes")), mapping(about.get("pool"))
    motion = next((known for run in runs if (known := mapping(run.data.get("motion")))), {})
    ours = {split: {**mapping(motion.get(split)), "samples": sizes.get(split)} for split in NUM_DATA}
    groups, columns, cells = ["<th></th>"], ["<th></th>"], dict.fromkeys(NUM_DATA, "")
    for name in NUM_DATA["train"]:
        has_ours = name == "samples" or any(counts.get(name) is not None for counts in ours.values())
        names = ("thesis", "ours") if has_ours else ("thesis",)
        groups.append(group(name, len(names)))
        columns += map(column, names)
        for split, counts in ours.items():
            cells[split] += _cell(NUM_DATA[split].get(name), "thesis")
            cells[split] += _cell(counts.get(name), "ours") if has_ours else ""
    groups.append("<th></th>")
    columns.append(column("hash of the pool of poses", "text"))
    rows = [
        f'<tr><th scope="row">{_SPLITS[split]}</th>{row}'
        f"{cell(mono(pool[split]) if pool.get(split) else NONE, 'text')}</tr>"
        for split, row in cells.items()
    ]
    caption = f"{len(runs)} run{'s' * (len(runs) > 1)}"
    return table("Numbers of data", (groups, columns), rows, caption=caption)


def _cell(value: Any, style: str) -> str:
    return cell(NONE, "none") if value is None else cell(_count(value), style)


def pictures(results: Results) -> str:
    """The best, median and worst test samples: one page of them for each row, of its first seed."""
    figures: dict[Path, str] = {}
    for result in results.tables:
        for row in result.rows:
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
        return f"<p>{MISSING}: no run left a picture.</p>"
    return f'<div class="pictures">{"".join(figures.values())}</div>'


def embed(path: Path) -> str | None:
    """A picture as a data URI, at most 1,600 pixels wide; None, with a warning, for a damaged one."""
    try:
        with Image.open(path, formats=("PNG",)) as opened:
            image = opened.convert("RGB")
    except _PICTURE_ERRORS as error:
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
    rows = []
    for number, run in enumerate(runs):
        record = run.record
        bodies = mapping(run.data.get("bodies")).items()
        versions = mapping(record.get("versions")).items()
        parameters = record.get("num_parameters")
        cells = (
            text(run.seed),
            text(run.status) if run.status == "complete" else f'<span class="word">{run.status}</span>',
            text(record.get("preset")),
            mono(record.get("config_hash")),
            _commit(record),
            _data(run),
            "<br>".join(f"{escape(str(name))} {mono(value)}" for name, value in bodies) or MISSING,
            mono(" ".join(run.overrides)) if run.overrides else "none",
            _trained_by(record) if parameters is None else _count(parameters),
            _duration(record.get("wall_time_s")),
            text(record.get("device")),
            text(record.get("started")),
            text(", ".join(f"{key} {value}" for key, value in versions)),
        )
        body = "".join(cell(value, "text") for value in cells)
        sub = f'<span class="sub">{escape(run.experiment)}</span>' if run.experiment else ""
        rows.append(f'<tr id="run-{number}"><th scope="row">{mono(run.name)}{sub}</th>{body}</tr>')
    head = [column(name, "text") for name in columns]
    caption = "Every number above is the mean over its row's runs."
    return table("Runs", (head,), rows, caption=caption, style="wide")


def _commit(record: Mapping[str, Any]) -> str:
    commit = record.get("commit")
    if not commit:
        return MISSING
    is_dirty = record.get("is_dirty")
    suffix = (
        {True: ", with changes", False: ", clean"}.get(is_dirty, "") if isinstance(is_dirty, bool) else ""
    )
    return mono(str(commit)[:10]) + suffix


def _data(run: Run) -> str:
    if not run.data:
        return MISSING
    version, detector = run.data.get("version"), mapping(run.data.get("detector")).get("hash")
    parts = [text(run.data.get("source")), mono(run.data.get("fingerprint"))]
    if version is not None:
        parts[0] += f" v{escape(str(version))}"
    if detector:
        parts.append(f"joints of {mono(detector)}")
    return "<br>".join(parts)


def _trained_by(record: Mapping[str, Any]) -> str:
    """Of an evaluation: whose checkpoint it evaluates."""
    if not record.get("trained_by"):
        return MISSING
    checkpoint = mapping(record.get("checkpoint"))
    place = f"epoch {text(checkpoint.get('epoch'))}, {mono(checkpoint.get('hash'))}"
    return f"those of {mono(record['trained_by'])}<br>{place}"


def _duration(seconds: Any) -> str:
    if not isinstance(seconds, int | float):
        return MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"


def _count(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else text(value)
