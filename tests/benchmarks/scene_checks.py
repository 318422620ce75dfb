"""Persons found in rooms without a mask; see `input_checks`."""

import logging
import time
from collections import Counter, defaultdict

import numpy as np

from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.report import Report
from tests.rooms import Scene, scenes

FOUND = 0.9
"""The least share of intersection in union of what is found and of the person."""


def measure(number: int, split: str) -> None:
    """Print the table."""
    outcomes: dict[str, Counter[str]] = defaultdict(Counter)
    quiet()
    pipeline = Pipeline.from_pretrained()
    milliseconds = []
    for scene in scenes(number, split):
        start = time.thread_time()
        outcome = outcome_of(scene, pipeline)
        milliseconds.append(1000 * (time.thread_time() - start))
        for label in ("all", *scene.labels):
            outcomes[label][outcome] += 1
    print(
        "| | scenes | found, % | found, doubted | refused | wrong, doubted | wrong, taken |\n|---|"
        + 6 * "---:|"
    )
    kinds = ("found", "found, doubted", "refused", "wrong, doubted", "wrong")
    for label, counts in outcomes.items():
        total = counts.total()
        print(
            f"| {label} | {total} | "
            + " | ".join(f"{100 * counts[kind] / total:.1f}" for kind in kinds)
            + " |"
        )
    print(f"\n{np.median(milliseconds):.0f} ms of one core in the median, {np.max(milliseconds):.0f} at most")


def quiet() -> None:
    """Doubts are counted, not shown."""
    logging.getLogger("ljn").setLevel(logging.ERROR)


def outcome_of(scene: Scene, pipeline: Pipeline) -> str:
    """What becomes of a scene."""
    report = Report()
    try:
        seen = pipeline.observe(scene.depth, scene.camera, report=report).depth > 0
    except ValueError:
        return "refused"
    is_found = np.count_nonzero(seen & scene.person) > FOUND * np.count_nonzero(seen | scene.person)
    return ("found" if is_found else "wrong") + (", doubted" if report.warnings else "")
