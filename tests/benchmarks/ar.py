"""The AR system on the synthetic recording: silhouettes, errors and jitter by where joints come from; and its speed.

    python -m tests.benchmarks.ar [--frames N] [--keypoint-detector FILE_OR_NAME ...] [--refine fast]

Prints a table: the mesh's silhouette against the true mask (IoU), MPJPE and PVE, with true 3D joints (the ceiling: what
the mesh regressor makes of them), true 2D joints, the 2D joints of keypoint detectors, and none; each without smoothing
and with it; jitter is the mean acceleration error of the joints.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from ljn.building import build
from ljn.metrics import apve, mpjpe
from ljn.pipeline.pipeline import Pipeline
from ljn.system.smoothing import SmoothingSettings
from ljn.system.system import ArSystem
from ljn.tasks.ar import silhouette_iou
from ljn.tasks.schema import register


class _Told:
    """A pipeline whose joints are the true ones."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline, self.joints = pipeline, np.zeros((24, 3), np.float32)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.pipeline, name)

    def predict(self, frames: Any) -> Any:
        return self.pipeline.predict(frames, self.joints[None])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--weights", default="small")
    parser.add_argument("--keypoint-detector", nargs="*", default=[])
    parser.add_argument("--refine", default=None)
    parser.add_argument("--segmentation", default="curtain")
    given = parser.parse_args()
    register()
    conf = str(Path(__file__).parents[2] / "conf")
    with initialize_config_dir(conf, version_base="1.3"):
        cfg = compose("config", ["task=ar", "recording=synthetic", f"segmentation={given.segmentation}"])
    recording = build(cfg.recording)
    frames = [frame for _, frame in zip(range(given.frames), recording.frames())]
    truths = [recording.truth(frame.number) for frame in frames]
    plain = Pipeline.from_pretrained(given.weights, refine=given.refine)
    rows: dict[str, tuple[Any, bool]] = {
        "true 3D joints": (_Told(Pipeline.from_pretrained(given.weights)), False),
        "true 2D joints": (plain, True),
    }
    for each in given.keypoint_detector:
        pipeline = Pipeline.from_pretrained(given.weights, refine=given.refine, keypoint_detector=each)
        rows[f"2D joints of {Path(each).stem}"] = (pipeline, False)
    rows["no 2D joints"] = (plain, False)
    print(f"{recording.name}, {len(frames)} frames, {given.segmentation}, refine {given.refine}\n")
    print(
        "| joints | smoothed | IoU | MPJPE, mm | PVE, mm | jitter, m/s^2 | failed | flips |\n|---|---|"
        + "---:|" * 6
    )
    for name, (pipeline, with_keypoints) in rows.items():
        for smoothing in (None, SmoothingSettings()):
            system = ArSystem(pipeline, recording.camera, build(cfg.segmentation), smoothing)
            results = []
            for frame, truth in zip(frames, truths):
                if isinstance(pipeline, _Told):
                    pipeline.joints = truth.joints
                results.append(system(frame, truth.keypoints if with_keypoints else None))
            print(_row(name, smoothing is not None, results, truths, recording), flush=True)
            if name == "no 2D joints" and smoothing is None:
                seconds = _seconds(results)
    rates = ", ".join(f"{stage} {1 / taken:.0f}" for stage, taken in seconds)
    print(
        f"\nframes/s of each stage, no 2D joints: {rates}; all {1 / sum(taken for _, taken in seconds):.1f}"
    )


def _row(name: str, is_smoothed: bool, results: list[Any], truths: list[Any], recording: Any) -> str:
    known = [(each, truth) for each, truth in zip(results, truths) if each.prediction is not None]
    values = {"iou": [], "mpjpe": [], "apve": []}
    for each, truth in known:
        found = each.prediction
        values["iou"].append(silhouette_iou(found.vertices, found.faces, truth.mask, recording))
        joints, vertices = (
            [torch.from_numpy(value) for value in pair]
            for pair in ((found.mesh_joints, truth.joints), (found.vertices, truth.vertices))
        )
        values["mpjpe"].append(float(mpjpe(*joints)))
        values["apve"].append(float(apve(*vertices)))
    iou, error, mesh = (np.mean(each) for each in values.values())
    jitter = np.mean(list(_accelerations(results, truths, recording.fps)))
    flips = sum(each.flip != "" for each in results)
    return (
        f"| {name} | {'yes' if is_smoothed else 'no'} | {iou:.3f} | {error:.1f} | {mesh:.1f} | {jitter:.1f} | "
        f"{len(results) - len(known)} | {flips} |"
    )


def _accelerations(results: list[Any], truths: list[Any], fps: float) -> Iterator[float]:
    """Of each three frames in a row, the mean distance of the joints' accelerations from the true ones, m/s^2."""
    for i in range(1, len(results) - 1):
        three = results[i - 1 : i + 2]
        if all(each.prediction is not None for each in three):
            found, true = (
                values[0] - 2 * values[1] + values[2]
                for values in (
                    [each.prediction.mesh_joints for each in three],
                    [each.joints for each in truths[i - 1 : i + 2]],
                )
            )
            yield float(np.linalg.norm(found - true, axis=-1).mean() * fps**2)


def _seconds(results: list[Any]) -> list[tuple[str, float]]:
    stages = list(results[-1].seconds)
    return [(stage, float(np.median([each.seconds[stage] for each in results]))) for stage in stages]


if __name__ == "__main__":
    main()
