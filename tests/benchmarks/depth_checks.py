"""The person found in a depth image: false alarms, and what becomes of wrong images; see `input_checks`."""

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from ljn.geometry.camera import Camera
from ljn.pipeline.depth import body_depth
from ljn.pipeline.report import Report
from tests.benchmarks.keypoint_checks import MOST_MUTATED, Sample, samples


class Given(NamedTuple):
    """What a user gives."""

    depth: np.ndarray
    camera: Camera
    mask: np.ndarray | None = None


def _widened(sample: Sample, pixels: int, gap_m: float) -> Given:
    """A mask too wide, before a wall."""
    body = sample.depth > 0
    wall = np.float32(sample.depth.max() + gap_m)
    scene = np.where(body, sample.depth, wall)
    return Given(scene, sample.camera, binary_dilation(body, iterations=pixels))


def _scattered(sample: Sample, value: float, rng: np.random.Generator) -> Given:
    """Half a percent of the body's pixels have another depth."""
    pixels = np.flatnonzero(sample.depth)
    depth = sample.depth.copy()
    depth.flat[rng.choice(pixels, max(1, len(pixels) // 200), replace=False)] = value
    return Given(depth, sample.camera)


def _halved(sample: Sample) -> Given:
    depth = np.ascontiguousarray(sample.depth[::2, ::2])
    height, width = depth.shape
    camera = sample.camera
    return Given(depth, Camera(camera.fx, camera.fy, camera.cx / 2, camera.cy / 2, width, height))


def _second(sample: Sample) -> Given:
    """Somebody like the first, mirrored, a metre behind and as far aside as the image allows."""
    other = np.where(sample.depth > 0, sample.depth + np.float32(1), 0)[:, ::-1]
    depth = np.where((sample.depth > 0) | (other == 0), sample.depth, other)
    return Given(np.ascontiguousarray(depth), sample.camera)


def _swapped(sample: Sample) -> Given:
    camera = sample.camera
    return Given(sample.depth, replace(camera, cx=camera.cy, cy=camera.cx))


MUTATIONS: dict[str, Callable[[Sample, np.random.Generator], Given]] = {
    "mask 4 px too wide, wall 0.1 m behind": lambda sample, _: _widened(sample, 4, 0.1),
    "mask 1 px too wide, wall 0.4 m behind": lambda sample, _: _widened(sample, 1, 0.4),
    "mask 2 px too wide, wall 1.6 m behind": lambda sample, _: _widened(sample, 2, 1.6),
    "mask 4 px too wide, wall 1.6 m behind": lambda sample, _: _widened(sample, 4, 1.6),
    "0.5 % of the pixels at 65.535 m": lambda sample, rng: _scattered(sample, 65.535, rng),
    "0.5 % of the pixels 1.5 m behind": lambda sample, rng: _scattered(sample, sample.depth.max() + 1.5, rng),
    "a second person behind": lambda sample, _: _second(sample),
    "image halved, camera not": lambda sample, _: _halved(sample),
    "focal length three times as long": lambda sample, _: Given(
        sample.depth, replace(sample.camera, fx=2.95 * sample.camera.fx, fy=2.95 * sample.camera.fy)
    ),
    "millimetres as floats": lambda sample, _: Given(1000 * sample.depth, sample.camera),
    "cx and cy swapped": lambda sample, _: _swapped(sample),
    "no mask, wall 0.4 m behind": lambda sample, _: Given(
        np.where(sample.depth > 0, sample.depth, sample.depth.max() + np.float32(0.4)), sample.camera
    ),
}
MENDED = 0.02
"""A wrong image is mended where so much of what is not the person is left at most."""


def measure(number: int, split: str) -> None:
    """Print the tables."""
    refused, doubted, lost, milliseconds = (defaultdict[str, list[float]](list) for _ in range(4))
    found: dict[str, list[str]] = defaultdict(list)
    rng = np.random.default_rng(0)
    for count, sample in enumerate(samples(split, number)):
        report, seen = Report(), None
        start = time.thread_time()
        with suppress(ValueError):
            seen = body_depth(sample.depth, sample.camera, None, report)
        spent = 1000 * (time.thread_time() - start)
        for group in (sample.sensor, sample.family, "all"):
            refused[group].append(seen is None)
            doubted[group].append(bool(report.warnings))
            if seen is not None:
                lost[group].append(1 - np.count_nonzero(seen) / np.count_nonzero(sample.depth))
            milliseconds[group].append(spent)
        if sample.sensor == "clutter" or count >= MOST_MUTATED * 2:
            continue  # of a body that is half hidden nothing is wrong that could be found
        for name, mutate in MUTATIONS.items():
            found[name].append(_outcome(sample, mutate(sample, rng)))
    print(f"right images, {number} samples\n")
    print(
        "| | samples | refused, of 10,000 | doubted | pixels dropped, mean | 99 % | ms |\n|---|" + 6 * "---:|"
    )
    for group, values in refused.items():
        dropped = 100 * np.array(lost[group])
        print(
            f"| {group} | {len(values)} | {1e4 * np.mean(values):.1f} | {1e4 * np.mean(doubted[group]):.1f} | "
            f"{dropped.mean():.2f} % | {np.percentile(dropped, 99):.2f} % | {np.median(milliseconds[group]):.1f} |"
        )
    print(
        "\n| wrong images | samples | refused, % | mended, % | doubted, % | taken as they are, % |\n|---|"
        + 5 * "---:|"
    )
    for name, outcomes in found.items():
        shares = [
            100 * np.mean([one == kind for one in outcomes])
            for kind in ("refused", "mended", "doubted", "taken")
        ]
        print(f"| {name} | {len(outcomes)} | " + " | ".join(f"{share:.1f}" for share in shares) + " |")


def _outcome(sample: Sample, given: Given) -> str:
    report = Report()
    try:
        seen = body_depth(given.depth, given.camera, given.mask, report)
    except ValueError:
        return "refused"
    if seen.shape == sample.depth.shape and given.camera == sample.camera:
        wrong = np.count_nonzero((seen > 0) & (np.abs(seen - sample.depth) > 0.05))
        if wrong <= MENDED * np.count_nonzero(sample.depth):
            return "mended"
    return "doubted" if report.warnings else "taken"
