"""What the sensors of conf/data/sensor cost, and what they do: the tables and the picture of docs/sensors.md.

    python -m tests.benchmarks.sensors                                   # tables
    python -m tests.benchmarks.sensors --pictures docs/sensors.png       # the picture
    python -m tests.benchmarks.sensors --pictures FILE --real DEPTH.png MASK.png   # with a real frame in its last row

Rates are of one thread's processor time, so that a busy machine changes them little: crops as `detector/cascade` takes
them, batches of 16, all rows in turn in every round, medians over rounds.
"""

import argparse
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from PIL import Image, ImageDraw, ImageFont

from datamodules import sensor as sensors
from datamodules.sensor import AxialNoise, Sensor, Step
from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SparseSMPL, load_body_models
from ljn.building import build
from ljn.cloud.observation import ObservationRecipe, body_box
from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import read_depth
from ljn.tasks.schema import register

CAMERA = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
CONF = Path(__file__).parents[2] / "conf"
PRESETS = sorted(path.stem for path in (CONF / "data" / "sensor").glob("*.yaml"))
STEPS = {
    name: step()
    for name, step in vars(sensors).items()
    if isinstance(step, type) and issubclass(step, Step) and step is not Step
}
BATCH, ROUNDS, TESTED = 16, 15, 256
SEED_OF_PICTURES, BODIES, TILE, LABEL = 3, 4, (150, 124), 104
"""Of the picture: bodies in a row, height and width of each, width of the names; pixels."""


class Preset(NamedTuple):
    """A file of conf/data/sensor: its chain, and the ranges of its cameras."""

    sensor: Sensor | None
    factors: dict[str, tuple[float, float]]


def read_preset(name: str) -> Preset:
    """A preset by its name."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("config", [f"data/sensor={name}", "experiment=detector/cascade"]).data
    factors = {key: tuple(cfg.synthesis[key]) for key in ("focal_factors", "pixel_factors")}
    return Preset(None if cfg.sensor is None else build(cfg.sensor), factors)


class Maker:
    """Makes synthesizers that share records and bodies."""

    def __init__(self, split: str, number: int) -> None:
        source = EmbeddedSource()
        self.bodies = load_body_models(None, source.genders)
        self.records = source.records(split, number, seed=0)
        self.layer = SparseSMPL(self.bodies)

    def __call__(
        self, sensor: Sensor | None, num_kept: int = 0, seed: int = 0, **settings: object
    ) -> DepthSynthesizer:
        """A synthesizer of crops."""
        given = (SynthesisSettings(**settings), ObservationRecipe(), ("crop", "crop_camera"))  # type: ignore[arg-type]
        made = DepthSynthesizer(
            *(self.records, self.bodies, CAMERA, *given, (seed, 0), torch.float32, num_kept, sensor)
        )
        made.__dict__["_smpl"] = self.layer
        return made


def print_rates(presets: dict[str, Preset]) -> None:
    """Samples a second of every preset and every step alone, and the time that they add to a sample."""
    make = Maker("train", BATCH)
    rows = {"gaussian": make(None, 1)}
    rows |= {name: make(preset.sensor, 1) for name, preset in presets.items() if preset.sensor}
    for name in ("low_resolution", "realistic"):
        rows[f"{name}, its cameras"] = make(presets[name].sensor, 1, **presets[name].factors)
    rows |= {f"`{name}`": make(Sensor({name: step}), 1) for name, step in STEPS.items()}
    once: dict[str, list[float]] = {name: [] for name in rows}
    twice: dict[str, list[float]] = {name: [] for name in rows}
    for epoch in range(-1, ROUNDS):
        for name, synthesizer in rows.items():
            start = time.thread_time()
            synthesizer.batch([(epoch + 1, index, 0) for index in range(BATCH)])
            middle = time.thread_time()
            synthesizer.batch([(epoch + 1, index, 1) for index in range(BATCH)])
            if epoch >= 0:  # the first round compiles
                once[name].append(1000 * (middle - start) / BATCH)
                twice[name].append(1000 * (time.thread_time() - start) / (2 * BATCH))
    print("\n| sensor | samples/s | of gaussian's | ms more | samples/s, `reuse` 2 | of gaussian's |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name in rows:
        cells = [name]
        for found in (once, twice):
            ms = statistics.median(found[name])
            ratio = statistics.median(first / own for first, own in zip(found["gaussian"], found[name]))
            cells += [f"{1000 / ms:.0f}", f"{100 * ratio:.0f} %"]
            if found is once:
                more = statistics.median(own - first for first, own in zip(once["gaussian"], once[name]))
                cells.append(f"{more:.2f}")
        print(f"| {' | '.join(cells)} |", flush=True)


def print_axial_noise() -> None:
    """Measured and published standard deviations of `AxialNoise` on planes."""
    print("\n| depth | 0 degrees | 30 degrees | 60 degrees |\n| ---: | ---: | ---: | ---: |")
    step, size, focal = AxialNoise(), 201, 4000.0
    camera, joints = Camera(focal, focal, 100, 100, size, size), np.zeros((24, 3))
    for z in (1.0, 2.0, 3.0, 4.0):
        cells = []
        for degrees in (0, 30, 60):
            angle = math.radians(degrees)
            slope = math.sin(angle) * (np.arange(size) - 100) / focal + math.cos(angle)
            plane = np.tile((z * math.cos(angle) / slope).astype(np.float32), (size, 1))
            taken = plane.copy()
            Sensor({"axial": step}).expose(taken, camera, joints, [degrees])
            noise = (taken - plane)[2:-2, 2:-2]
            cells.append(
                f"{1000 * noise.std():.2f} / {1000 * step.sigma_m(np.array(z), np.array(angle)):.2f}"
            )
        print(f"| {z:.0f} m | {' | '.join(cells)} |")


def print_statistics(presets: dict[str, Preset]) -> None:
    """What becomes of the test samples' pixels."""
    make = Maker("test", TESTED)
    title = "| sensor | lost, mean / p90 | added | flying, of the border | error of the others | height, percentiles |"
    print(f"\n{title}\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, (sensor, factors) in presets.items():
        clean = sensor and replace(sensor, steps={n: without_image(s) for n, s in sensor.steps.items()})
        lost, added, flying, errors, heights = [], [], [], [], []
        for start in range(0, TESTED, BATCH):
            keys = [(0, index) for index in range(start, start + BATCH)]
            before = make(clean, depth_noise_m=0.0, **factors).examples(keys)[1].numpy()
            after = make(sensor, **factors).examples(keys)[1].numpy()
            for old, new in zip(before, after):
                body, seen = old > 0, new > 0
                is_flying = body & seen & (new - old > 0.05)
                border = near_jump(old)
                lost.append((body & ~seen).sum() / body.sum())
                added.append((seen & ~body).sum() / body.sum())
                flying.append((is_flying & border).sum() / border.sum())
                errors.append(np.median(np.abs(new - old)[body & seen]))
                _, _, top, bottom = body_box(old)
                heights.append(bottom + 1 - top)
        tall = " / ".join(f"{height:.0f}" for height in np.percentile(heights, [10, 50, 90]))
        cells = [
            f"{100 * np.mean(lost):.1f} / {100 * np.quantile(lost, 0.9):.1f} %",
            *(f"{100 * np.mean(values):.1f} %" for values in (added, flying)),
            f"{1000 * np.mean(errors):.1f} mm",
            f"{tall} px",
        ]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def without_image(step: Step) -> Step:
    """A step, switched off where it changes images."""
    return step if type(step).expose is Step.expose else replace(step, share=0.0)


def near_jump(depth: np.ndarray) -> np.ndarray:
    """The pixels of the body beside the background, or before something 8 cm farther."""
    padded = np.pad(depth, 1)
    sides = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return (depth > 0) & np.any([(side == 0) | (side > depth + 0.08) for side in sides], 0)


def shaded(depth: np.ndarray, focal: float) -> np.ndarray:
    """A depth image `(H, W)`, metres, as a surface lit from the left above: grey values `(H, W)`, white around."""
    slopes = []
    for axis in range(2):
        both = []
        for shift in (1, -1):
            other = np.roll(depth, shift, axis)
            both.append(np.where(other > 0, shift * (depth - other), np.inf))
        nearer = np.where(np.abs(both[0]) < np.abs(both[1]), *both)
        slopes.append(np.where(np.isfinite(nearer), nearer, 0) * focal / np.maximum(depth, 0.1))
    light = (0.35 * slopes[0] + 0.25 * slopes[1] + 0.9) / np.sqrt(slopes[0] ** 2 + slopes[1] ** 2 + 1)
    return np.where(depth > 0, 40 + 180 * np.clip(light, 0, 1), 255).astype(np.uint8)


def tile(depth: np.ndarray, focal: float) -> Image.Image:
    """The body of a depth image in a tile: small ones enlarged, of large ones every second pixel, or so."""
    left, right, top, bottom = body_box(depth)
    part = depth[top : bottom + 1, left : right + 1]
    fit = min(TILE[0] / part.shape[0], TILE[1] / part.shape[1])
    step, times = max(1, round(1 / fit)), max(1, int(fit))
    image = shaded(np.pad(part[::step, ::step], 1), focal / step)[1:-1, 1:-1]
    page = Image.new("L", TILE[::-1], 255)
    image = image.repeat(times, 0).repeat(times, 1)
    page.paste(Image.fromarray(image), ((TILE[1] - image.shape[1]) // 2, (TILE[0] - image.shape[0]) // 2))
    return page


def draw(presets: dict[str, Preset], real: Sequence[str], real_focal: float) -> Image.Image:
    """A page with a row for each step and each preset, in two columns; real frames come last."""
    make, keys = Maker("test", 40), [(0, index) for index in (2, 4, 11, 23)][:BODIES]
    same = {"focal_factors": (1.0, 1.0), "pixel_factors": (0.55, 0.55)}
    same |= {"distance_m": (2.6, 2.6), "heading": "histogram", "margin_px": 2.0}
    rows: list[tuple[str, list[Image.Image]]] = []

    def add(name: str, sensor: Sensor | None, settings: dict[str, object]) -> None:
        batch, depth = make(sensor, seed=SEED_OF_PICTURES, **settings).examples(keys)
        focal = batch["camera"][:, 0].tolist()
        rows.append((name, [tile(image, f) for image, f in zip(depth.numpy(), focal)]))

    add("no sensor", None, {**same, "depth_noise_m": 0.0})
    for name, step in STEPS.items():
        add(name, Sensor({name: step}), same)
    for name, (sensor, factors) in presets.items():
        is_default = all(low == high == 1 for low, high in factors.values())
        add(f"data/sensor=\n{name}", sensor, same if is_default else dict(factors))
    if real:
        depth = np.array(read_depth(Path(real[0])), np.float32)
        depth = depth / 1000 if depth.max() > 100 else depth
        if len(real) > 1:
            depth[np.array(Image.open(real[1]).convert("L")) == 0] = 0
        rows.append(("a real frame", [tile(depth.astype(np.float32), real_focal)]))
    half = -(-len(rows) // 2)
    width = LABEL + BODIES * TILE[1]
    page = Image.new("L", (2 * width, half * TILE[0]), 255)
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for number, (name, tiles) in enumerate(rows):
        x, y = number // half * width, number % half * TILE[0]
        pen.text((x + 4, y + TILE[0] // 2 - 12), name, fill=0, font=font)
        for place, image in enumerate(tiles):
            page.paste(image, (x + LABEL + place * TILE[1], y))
        pen.line([(x, y), (x + width, y)], fill=215)
    return page.quantize(24)


def main() -> None:
    """Print the tables, or draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pictures", type=Path, metavar="FILE.png")
    parser.add_argument("--real", nargs="+", default=(), metavar="PNG", help="a depth image, and its mask")
    parser.add_argument("--real-focal", type=float, default=366.0, help="its focal length, pixels")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    register()
    presets = {name: read_preset(name) for name in PRESETS}
    if arguments.pictures:
        draw(presets, arguments.real, arguments.real_focal).save(arguments.pictures, optimize=True)
        return
    print_axial_noise()
    print_statistics(presets)
    print_rates(presets)


if __name__ == "__main__":
    main()
