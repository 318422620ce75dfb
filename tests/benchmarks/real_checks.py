"""Real frames, which are no part of the project: what is found in them, with and without masks; see `input_checks`."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation

from ljn.geometry.camera import Camera
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.report import Report
from tests.benchmarks.scene_checks import FOUND, quiet


class _Frame(NamedTuple):
    name: str
    depth: np.ndarray
    mask: np.ndarray  # the person's
    camera: Camera


def measure(folder: Path, pictures: Path | None) -> None:
    """Print a table; write a picture of each frame: grey depth, green what is found, red what is dropped."""
    quiet()
    pipeline = Pipeline.from_pretrained()
    counts = {name: Counter[str]() for name in ("mask", "mask 2 px too wide", "no mask")}
    for frame in _frames(folder):
        row = []
        for name, outcomes in counts.items():
            wide = binary_dilation(frame.mask, iterations=2)
            mask = {"mask": frame.mask, "no mask": None}.get(name, wide)
            report = Report()
            try:
                seen = pipeline.observe(frame.depth, frame.camera, mask=mask, report=report).depth > 0
                person = frame.mask & (frame.depth > 0)
                is_found = np.count_nonzero(seen & person) > FOUND * np.count_nonzero(seen | person)
                outcomes[("found" if is_found else "wrong") + (", doubted" if report.warnings else "")] += 1
            except ValueError:
                seen = np.zeros(frame.depth.shape, bool)
                outcomes["refused"] += 1
            row.append(_picture(frame, seen, mask))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.concatenate(row, 1)).save(pictures / f"{frame.name}.png")
    kinds = ("found", "found, doubted", "refused", "wrong, doubted", "wrong")
    print(f"| | {' | '.join(kinds)} |\n|---|" + len(kinds) * "---:|")
    for name, outcomes in counts.items():
        print(f"| {name} | " + " | ".join(str(outcomes[kind]) for kind in kinds) + " |")


def _frames(folder: Path) -> list[_Frame]:
    millimetres = np.asarray(Image.open(folder / "depthkit_chae_depth.png"))
    person = np.asarray(Image.open(folder / "depthkit_chae_mask.png")) > 0
    walled = np.where(person, millimetres, 3000) / np.float32(1000)  # its background is gone
    frames = [_Frame("depthkit", walled, person, Camera(366, 366, 256, 212, 512, 424))]
    with np.load(folder / "itop_front.npz") as itop:
        camera = Camera(*map(float, itop["K"]), 100, 100)
        for number, (depth, mask) in enumerate(zip(itop["depth_m"], itop["mask"])):
            frames.append(_Frame(f"itop_{number:02d}", depth, mask, camera))
    return frames


def _picture(frame: _Frame, seen: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    is_measured = frame.depth > 0
    near, far = np.percentile(frame.depth[is_measured], [1, 99])
    grey = np.where(is_measured, 220 - 160 * np.clip((frame.depth - near) / (far - near), 0, 1), 0)
    image = np.repeat(grey[..., None], 3, -1)
    image[seen, 1] = 255
    dropped = is_measured & ~seen & (mask if mask is not None else frame.mask)
    image[dropped] = (255, 0, 0)
    size = 3 if max(image.shape) < 200 else 1
    return image.astype(np.uint8).repeat(size, 0).repeat(size, 1)
