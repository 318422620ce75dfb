"""Keypoints held against the body: false alarms and what is found of wrong ones; see `input_checks`."""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from datamodules.sources.embedded.source import FAMILY_SHARES, EmbeddedSource
from datamodules.synthesis import DepthSynthesizer
from ljn.body import load_body_models
from ljn.cloud.observation import ObservationRecipe
from ljn.geometry.camera import Camera
from ljn.pipeline.keypoint_orders import middles_of
from ljn.pipeline.keypoints import Keypoints, body_keypoints
from ljn.pipeline.report import Report
from ljn.tasks.schema import register

SENSORS = ("gaussian", "kinect_v2", "structured_light", "clutter", "realistic", "low_resolution")
SHARES = {"whole": 0.25, "swapped": 0.1, "mixed": 0.15, "procedural": 0.5}
NOISE_PX, FOCAL_PX = 10.0, 366.458
MISSING = 0.3
WILD, SURE, UNSURE = (
    0.15,
    (0.5, 1.0),
    (0.0, 0.15),
)  # share of wild keypoints where confidences tell them; those
MOVED_M = 0.15
MOST_MUTATED = 2500  # samples, at most half of them
CHUNK = 32
GIVEN = ("coco17", "body25", "kinect25", "smpl24", "h36m17", "coco18", "azure32", "mediapipe33")


class Sample(NamedTuple):
    """A body seen by a camera."""

    sensor: str
    family: str
    camera: Camera
    depth: np.ndarray  # (H, W), metres
    joints: np.ndarray  # (24, 2), pixels


def samples(split: str, number: int, seed: int = 0) -> Iterator[Sample]:
    """Samples of each sensor in turn, in equal numbers."""
    register()
    source = EmbeddedSource(shares=SHARES, families=dict.fromkeys(FAMILY_SHARES, 1.0))
    bodies = load_body_models(None, source.genders)
    records = source.records(split, number, seed)
    for turn, sensor in enumerate(SENSORS):
        with initialize_config_dir(str(Path(__file__).parents[2] / "conf"), version_base="1.3"):
            data = compose("config", [f"data/sensor={sensor}", "data.synthesis.heading=uniform"]).data
        camera, settings, chain = (
            None if data[key] is None else instantiate(data[key]) for key in ("camera", "synthesis", "sensor")
        )
        recipe, takes = ObservationRecipe(1), ("keypoints", "crop")
        synthesizer = DepthSynthesizer(
            *(records, bodies, camera, settings, recipe, takes, (seed, 5)), sensor=chain
        )
        rows = range(turn, number, len(SENSORS))
        for start in range(0, len(rows), CHUNK):
            keys = [(0, row) for row in rows[start : start + CHUNK]]
            batch, depth = synthesizer.examples(keys)
            for key, image, joints in zip(keys, depth.numpy(), batch["true_keypoints"].numpy()):
                seen = synthesizer._camera_of(key)
                name = str(records.sequence[key[1]]).split("|")[0]
                family = name.removeprefix("proc/") if name.startswith("proc/") else "clips"
                yield Sample(sensor, family, seen, image[: seen.height, : seen.width], joints)


def places(joints: np.ndarray, order: str) -> np.ndarray:
    """All keypoints of an order `(K, 2)` of a body's joints `(24, 2)`, at those that they stand for or are beside."""
    return middles_of(order) @ joints


def outcome(keypoints: Any, sample: Sample) -> tuple[Keypoints | None, Report, str]:
    """What becomes of keypoints: the result, or none and the error."""
    report = Report()
    try:
        return body_keypoints(keypoints, sample.depth, sample.camera, 1, report), report, ""
    except ValueError as error:
        return None, report, str(error)


Mutation = Callable[[np.ndarray, Camera], np.ndarray]
MUTATIONS: dict[str, Mutation] = {
    "u and v swapped": lambda p, c: p[:, ::-1],
    "v from below": lambda p, c: np.stack([p[:, 0], c.height - 1 - p[:, 1]], 1),
    # 80 px of the training camera, towards the image's middle.
    "shifted by 80 px": lambda p, c: p + np.array([_towards_middle(p, c) * 80 * c.fx / FOCAL_PX, 0]),
    "scaled by 1.25": lambda p, c: 1.25 * p,
    "scaled by 0.8": lambda p, c: 0.8 * p,
    "all at one pixel": lambda p, c: 0 * p + np.nanmean(p, 0),
    "shares of the size": lambda p, c: p / [c.width, c.height],
}


def _towards_middle(positions: np.ndarray, camera: Camera) -> float:
    return 1.0 if np.nanmean(positions[:, 0]) < camera.width / 2 else -1.0


def measure(number: int, split: str = "test", seed: int = 0, made: Iterator[Sample] | None = None) -> None:
    """Print the tables."""
    right: dict[str, Counter[str]] = defaultdict(Counter)
    found: dict[str, Counter[str]] = defaultdict(Counter)
    examples: dict[str, str] = {}
    milliseconds = []
    every = max(2, number // MOST_MUTATED)
    for index, sample in enumerate(made or samples(split, number, seed)):
        rng = np.random.default_rng([seed, index])
        order = GIVEN[index // len(SENSORS) % len(GIVEN)]
        noise = NOISE_PX * sample.camera.fx / FOCAL_PX
        true = places(sample.joints, order)
        given = true + noise * rng.standard_normal(true.shape)
        given[rng.random(len(given)) < MISSING] = np.nan
        if order == "mediapipe33":
            given /= [sample.camera.width, sample.camera.height]
        start = time.process_time()
        result, report, error = outcome(given, sample)
        milliseconds.append(1000 * (time.process_time() - start))
        is_refused = result is None and ("expected at least" not in error)
        is_other = report.facts.get("keypoint_order", order) != order
        events = {
            "all": True,
            "refused": is_refused,
            "warned": bool(report.warnings),
            "mistrusted": bool(report.facts.get("keypoints_mistrusted")),
            "another order": is_other,
        }
        for name in ("all", sample.sensor, sample.family, order):
            right[name].update(event for event, is_so in events.items() if is_so)
        if is_refused or is_other:
            examples.setdefault(f"{sample.sensor} {sample.family} {order}", error or str(report.facts))
        if index % every or result is None:
            continue
        for name, mutated in _mutated(true, noise, order, sample, rng):
            _count(found[name], examples, name, mutated, sample)

    print(f"right keypoints, {split} poses: of each 10,000")
    columns = ("refused", "warned", "mistrusted", "another order")
    print(f"{'':20s}{'samples':>10s}" + "".join(f"{column:>16s}" for column in columns))
    for name, counts in right.items():
        shares = "".join(f"{1e4 * counts[column] / counts['all']:16.1f}" for column in columns)
        print(f"{name:20s}{counts['all']:10d}{shares}")
    print(f"milliseconds: median {np.median(milliseconds):.2f}, 95 % {np.percentile(milliseconds, 95):.2f}")
    print(f"\nwrong keypoints, that move by more than {1000 * MOVED_M:.0f} mm: shares, %")
    print(
        f"{'':32s}{'samples':>10s}{'refused':>10s}{'mended':>10s}{'either':>10s}{'named':>10s}{'warned':>10s}"
    )
    for name, counts in found.items():
        total = max(1, counts["all"])
        refused, mended = counts["refused"], counts["mended"]
        shares = [refused, mended, refused + mended, counts["named"], counts["warned"]]
        print(f"{name:32s}{counts['all']:10d}" + "".join(f"{100 * share / total:10.1f}" for share in shares))
    print("\nexamples")
    for name, error in list(examples.items())[:24]:
        print(f"{name}: {error}")


def _mutated(
    true: np.ndarray, noise: float, order: str, sample: Sample, rng: np.random.Generator
) -> Iterator[tuple[str, Any]]:
    """Wrong keypoints of a sample: kinds and values."""
    given = true + noise * rng.standard_normal(true.shape)
    given[rng.random(len(given)) < MISSING] = np.nan
    for name, mutate in MUTATIONS.items():
        if name == "shares of the size" and order == "mediapipe33":
            continue
        mutated = mutate(given, sample.camera)
        if _metres(mutated - given, sample) > MOVED_M:
            yield name, mutated
    if order == "kinect25":
        yield "Kinect's 25 as body25", {"order": "body25", "keypoints": given}
    elif order == "body25":
        yield "BODY_25's 25 as kinect25", {"order": "kinect25", "keypoints": given}
    elif order == "h36m17":
        yield "H36M's 17 as coco17", {"order": "coco17", "keypoints": given}
    given = true + noise * rng.standard_normal(true.shape)
    is_wild = rng.random(len(given)) < WILD
    size = [sample.camera.width, sample.camera.height]
    given[is_wild] = rng.random((is_wild.sum(), 2)) * size
    confidences = np.where(is_wild, rng.uniform(*UNSURE, len(given)), rng.uniform(*SURE, len(given)))
    yield "confidences in percent", np.concatenate([given, 100 * confidences[:, None]], 1)
    scores = np.ones(len(given))
    yield "wild ones not told (no scores)", np.concatenate([given, scores[:, None]], 1)


def _count(counts: Counter[str], examples: dict[str, str], name: str, keypoints: Any, sample: Sample) -> None:
    """Add what became of one wrong input."""
    result, report, error = outcome(keypoints, sample)
    counts["all"] += 1
    if result is None:
        counts["refused"] += 1
        counts["named"] += "they would" in error or "multiply" in error
        examples.setdefault(name, error)
        return
    counts["mended"] += _metres(result.positions - sample.joints, sample) <= MOVED_M
    counts["warned"] += bool(report.warnings)


def _metres(pixels: np.ndarray, sample: Sample) -> float:
    """Mean length of steps `(K, 2)` in the image, at the body's depth."""
    depth_m = float(np.median(sample.depth[sample.depth > 0]))
    return depth_m / sample.camera.fx * float(np.nanmean(np.linalg.norm(pixels, axis=-1)))
