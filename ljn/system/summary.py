"""A recording's summary: numbers, and a page to look at."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ljn.report.markup import cell, column, facts, section, table
from ljn.report.style import STYLE

STAGES = (
    "reading",
    "segmentation",
    "2D joints",
    "joints and mesh",
    "flips",
    "smoothing",
    "overlay",
    "writing",
)


def summarise(frames: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a summary says of a recording's frames.

    Args:
        frames: `StoredFrame.about` of each, with `number` and `name`.

    Returns:
        `frames`, `predicted`, `failed`, `doubtful`; `flips_corrected`, `flips_unclear`; `frames_per_second` by stage
        and of all together (`all`); means of what frames say of the truth (`iou`, `mpjpe_mm`, `apve_mm`), and
        `confidence`, the mean of the 2D joints'; `errors`, each with the number of frames that it stopped: those that
        differ by numbers alone are one, as the first frame said it.
    """
    kinds: dict[str, list[str]] = {}
    for frame in frames:
        if frame["error"] is not None:
            kinds.setdefault(re.sub(r"\d+(\.\d+)?", "#", frame["error"]), []).append(frame["error"])
    errors = {told[0]: len(told) for told in kinds.values()}
    seconds = {
        stage: float(np.mean(taken))
        for stage in STAGES
        if (taken := [frame["seconds"][stage] for frame in frames if stage in frame["seconds"]])
    }
    made: dict[str, Any] = {
        "frames": len(frames),
        "predicted": len(frames) - sum(errors.values()),
        "failed": sum(errors.values()),
        "doubtful": sum(bool(frame["warnings"]) for frame in frames),
        **{
            f"flips_{kind}": sum(frame["flip"] == kind for frame in frames)
            for kind in ("corrected", "unclear")
        },
        "frames_per_second": {stage: 1 / max(taken, 1e-9) for stage, taken in seconds.items()},
        "errors": errors,
    }
    if seconds:
        made["frames_per_second"]["all"] = 1 / sum(seconds.values())
    for key in ("iou", "mpjpe_mm", "apve_mm", "confidence"):
        if known := [frame[key] for frame in frames if frame.get(key) is not None]:
            made[key] = float(np.mean(known))
    return made


def page(
    title: str, summary: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], summary_file: str
) -> str:
    """The page: the video, the numbers, what became of the frames that failed or were doubted.

    Args:
        title: The recording's name.
        summary: See `summarise`; and `recording`, the recording's facts, and `files`, names of what lies beside the
            page.
        frames: See `summarise`.
        summary_file: The name of the summary's file, beside the page.
    """
    shown = {
        "frames": summary["frames"],
        "without a person": summary["failed"],
        "doubted": summary["doubtful"],
        "sides exchanged, mended": summary["flips_corrected"],
        "sides unclear": summary["flips_unclear"],
    }
    units = {"iou": "", "mpjpe_mm": " mm", "apve_mm": " mm", "confidence": ""}
    names = {"iou": "silhouette IoU", "mpjpe_mm": "MPJPE", "apve_mm": "PVE", "confidence": "2D confidence"}
    shown |= {
        names[key]: f"{summary[key]:.2f}" if not unit else f"{summary[key]:.1f}{unit}"
        for key, unit in units.items()
        if key in summary
    }
    video = next((name for name in summary["files"] if name.endswith(".mp4")), "")
    parts = [facts(shown)]
    if video:
        parts.append(f'<video src="{video}" controls loop muted playsinline style="max-width:100%"></video>')
    about = {name.replace("_", " "): value for name, value in summary["recording"].items()}
    parts.append(section("recording", "Recording", facts(about)))
    rates = [
        f'<tr><th scope="row">{escape(stage)}</th>{cell(f"{rate:.1f}")}{cell(f"{1000 / rate:.1f}")}</tr>'
        for stage, rate in summary["frames_per_second"].items()
    ]
    head = [[column("stage", "text"), column("frames/s"), column("ms")]]
    parts.append(section("speed", "Speed", table("speed", head, rates)))
    told = [
        f"<tr>{cell(str(frame['number']), 'text')}{cell(escape(frame['name']), 'text')}"
        f"{cell(escape(_told(frame)), 'text')}</tr>"
        for frame in frames
        if _told(frame)
    ]
    if told:
        head = [[column("frame", "text"), column("name", "text"), column("what was said", "text")]]
        parts.append(section("frames", "Frames that failed or were doubted", table("frames", head, told)))
    links = "".join(
        f'<li><a href="{escape(name, quote=True)}">{escape(name)}</a></li>'
        for name in (*summary["files"], summary_file)
    )
    parts.append(section("files", "Files", f"<ul>{links}</ul>"))
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body><header><p class=eyebrow>recording</p><h1>{escape(title)}</h1></header>"
        f"<main>{''.join(parts)}</main></body></html>"
    )


def _told(frame: Mapping[str, Any]) -> str:
    """What was said of a frame; nothing of one that went well."""
    said = [frame["error"]] if frame["error"] is not None else []
    if frame["flip"]:
        said.append(f"sides {frame['flip']}")
    return "; ".join([*said, *frame["warnings"]])
