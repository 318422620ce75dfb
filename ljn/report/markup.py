"""Pieces of HTML that the page's parts share."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

MISSING = '<span class="word">missing</span>'


def text(value: Any) -> str:
    """A value for HTML; the word `missing` for none."""
    return MISSING if value is None or value == "" else escape(str(value))


def mono(value: Any) -> str:
    """A hash or a name for HTML; the word `missing` for none."""
    return MISSING if value is None or value == "" else f'<span class="mono">{escape(str(value))}</span>'


def facts(values: Mapping[str, Any]) -> str:
    """Values under their names."""
    listed = "".join(f"<div><dt>{name}</dt><dd>{text(value)}</dd></div>" for name, value in values.items())
    return f'<dl class="facts">{listed}</dl>'


def section(name: str, title: str, content: str, style: str = "") -> str:
    """A section of the page with a heading, to which `#name` leads."""
    name = escape(name, quote=True)
    mark = f' class="{style}"' if style else ""
    return f'<section{mark} aria-labelledby="{name}"><h2 id="{name}">{escape(title)}</h2>{content}</section>'


def table(
    label: str, head: Sequence[Sequence[str]], *bodies: Sequence[str], caption: str = "", style: str = ""
) -> str:
    """A table of heading rows (of `th`) and groups of rows (`tr`), in a box that scrolls, also from the keyboard."""
    rows = "".join(f"<tr>{''.join(cells)}</tr>" for cells in head)
    groups = "".join(f"<tbody>{''.join(body)}</tbody>" for body in bodies if body)
    mark = f' class="{style}"' if style else ""
    above = f"<caption>{caption}</caption>" if caption else ""
    return (
        f'<div class="scroll" role="region" aria-label="{escape(label, quote=True)}" tabindex="0">'
        f"<table{mark}>{above}<thead>{rows}</thead>{groups}</table></div>"
    )


def group(name: str, span: int) -> str:
    """A heading over several columns."""
    return f'<th scope="colgroup" colspan="{span}"><span>{escape(name)}</span></th>'


def column(name: str, style: str = "") -> str:
    """A column's heading."""
    return f'<th scope="col"{f" class={style}" if style else ""}>{escape(name)}</th>'


def cell(value: str, style: str = "") -> str:
    """A cell of HTML."""
    return f'<td class="{style}">{value}</td>' if style else f"<td>{value}</td>"
