"""The AR system on the synthetic recording: silhouettes, errors and jitter by where joints come from; and its speed.

    python -m tests.benchmarks.ar [--frames N] [--keypoint-detector FILE_OR_NAME ...] [--refine fast]
    python -m tests.benchmarks.ar --flips [--clip CLIP] [--start N] [--frames N] [--keypoint-detector FILE_OR_NAME ...]
    python -m tests.benchmarks.ar --memory 2000

The first prints a table: the mesh's silhouette against the true mask (IoU), MPJPE and PVE, with true 3D joints (the
ceiling: what the mesh regressor makes of them), true 2D joints, the 2D joints of keypoint detectors, and none; each
without smoothing and with it; jitter is the mean acceleration error of the joints.

The second exchanges the sides of the 2D joints in some frames, and prints what becomes of them. The third runs
`task=ar` over so many frames, and prints its resident memory on the way.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from datamodules.recording import write_recording
from ljn.body.skeleton import MIRROR
from ljn.building import build
from ljn.metrics import apve, mpjpe
from ljn.pipeline.keypoints import Keypoints
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
    parser.add_argument("--flips", action="store_true")
    parser.add_argument("--memory", type=int)
    parser.add_argument("--clip", default="humanoid3d_dance_b")
    parser.add_argument("--start", type=int, default=0)
    given = parser.parse_args()
    register()
    chosen = [f"segmentation={given.segmentation}", f"recording.clip={given.clip}"]
    chosen += [f"recording.start={given.start}"]
    conf = str(Path(__file__).parents[2] / "conf")
    with initialize_config_dir(conf, version_base="1.3"):
        cfg = compose("config", ["task=ar", "recording=synthetic", *chosen])
    recording = build(cfg.recording)
    if given.memory is not None:
        print_memory(recording, given.memory)
        return
    frames = [frame for _, frame in zip(range(given.frames), recording.frames())]
    truths = [recording.truth(frame.number) for frame in frames]
    if given.flips:
        print_flips(recording, frames, truths, build(cfg.segmentation), given)
        return
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


_WRITTEN = 20  # frames that a long recording repeats


class _Exchanging:
    """A keypoint detector: one that there is, or else the truth; in some frames it takes left for right.

    Args:
        find: Finds the keypoints as `KeypointFinder` does; None: they are `true`.
    """

    sees = "depth"

    def __init__(self, find: Any) -> None:
        self.find = find
        self.true, self.is_exchanged = np.zeros((24, 2), np.float32), False

    def __call__(self, *image: Any) -> Keypoints:
        found = Keypoints(self.true, np.ones(24, np.float32)) if self.find is None else self.find(*image)
        return Keypoints(*(each[list(MIRROR)] for each in found)) if self.is_exchanged else found


_FLIPS: dict[str, tuple[list[int], list[int]]] = {
    "none": ([], []),
    "every tenth frame": (list(range(5, 100, 10)), []),
    "three runs of 5": ([*range(20, 25), *range(50, 55), *range(80, 85)], []),
    "a run of 20": (list(range(40, 60)), []),
    "half of them, at random": (np.flatnonzero(np.random.default_rng(0).random(100) < 0.5).tolist(), []),
    "all": (list(range(100)), []),
    "the first frame": ([0], []),
    "the first 10": (list(range(10)), []),
    "10 after a gap of 20": (list(range(60, 70)), list(range(40, 60))),
}
"""Frames whose sides are exchanged, and frames that cannot be read."""


def print_flips(recording: Any, frames: list[Any], truths: list[Any], segmenter: Any, given: Any) -> None:
    """What becomes of exchanged sides.

    A frame is flipped where its joints are nearer to the true ones with the sides exchanged. "Before" is what the
    networks make of the keypoints; "detected" counts those of them that are corrected or called unclear; "left" are
    flipped in the end, "spoilt" are left ones that were right before.
    """
    masks = {frame.number: segmenter(frame, recording.camera) for frame in frames}
    print(f"{recording.name}, {len(frames)} frames, refine {given.refine}\n")
    print(
        "| 2D joints | exchanged | frames | flipped before | detected | corrected | left | spoilt | unclear | "
        "MPJPE, mm | before |\n|---|---|" + "---:|" * 9
    )
    for name in ["true", *given.keypoint_detector]:
        detector = None if name == "true" else name
        pipeline = Pipeline.from_pretrained(given.weights, refine=given.refine, keypoint_detector=detector)
        pipeline.finder = finder = _Exchanging(pipeline.finder)  # type: ignore[assignment]

        def predicted(
            chosen: set[int],
            lost: set[int],
            mends: bool,
            pipeline: Pipeline = pipeline,
            finder: _Exchanging = finder,
        ) -> list[Any]:
            segmenter = lambda frame, _: masks[frame.number]  # noqa: E731
            system, results = ArSystem(pipeline, recording.camera, segmenter, mends_flips=mends), []
            for frame, truth in zip(frames, truths):
                finder.true, finder.is_exchanged = truth.keypoints, frame.number in chosen
                lack = frame._replace(depth=None, error="lost") if frame.number in lost else frame
                results.append(system(lack))
            return results

        both = {
            is_all: predicted(set(range(len(frames))) if is_all else set(), set(), False)
            for is_all in (False, True)
        }
        for kind, (chosen, lost) in _FLIPS.items():
            raw = [both[number in chosen][number] for number in range(len(frames))]
            found = predicted(set(chosen), set(lost), True)
            known = [number for number in range(len(frames)) if number not in lost]
            before, after = (
                {n for n in known if _is_flipped(of[n].prediction.joints, truths[n].joints)}
                for of in (raw, found)
            )
            said = {flip: {n for n in known if found[n].flip == flip} for flip in ("corrected", "unclear")}
            errors = [
                np.mean(
                    [
                        np.linalg.norm(of[n].prediction.joints - truths[n].joints, axis=-1).mean()
                        for n in known
                    ]
                )
                for of in (found, raw)
            ]
            numbers = [
                len(set(chosen) & set(known)),
                len(before),
                len(before & (said["corrected"] | said["unclear"])),
                len(before & said["corrected"] - after),
                len(after),
                len(after - before),
                len(said["unclear"]),
            ]
            print(
                f"| {name} | {kind} | "
                + " | ".join(map(str, numbers))
                + f" | {1000 * errors[0]:.1f} | {1000 * errors[1]:.1f} |",
                flush=True,
            )


def print_memory(recording: Any, number: int) -> None:
    """What `task=ar` holds in memory after so many frames, as Linux counts it, and at most, to its end."""
    with TemporaryDirectory() as folder:
        source, long, results = (Path(folder) / name for name in ("source", "long", "results"))
        write_recording(recording, source, _WRITTEN)
        for kind in ("depth", "rgb"):
            (long / kind).mkdir(parents=True)
            for i in range(number):  # to the end and back
                row = _WRITTEN - 1 - abs(_WRITTEN - 1 - i % (2 * _WRITTEN - 2))
                (long / kind / f"{i:06d}.png").hardlink_to(source / kind / f"{row:06d}.png")
        (source / "camera.yaml").rename(long / "camera.yaml")
        command = [sys.executable, "run.py", "task=ar", f"input={long}", "segmentation=curtain"]
        command += ["task.smooth=true", "trainer.accelerator=cpu", f"paths.output_dir={results}"]
        with subprocess.Popen(command, cwd=Path(__file__).parents[2]) as process:
            print("\n| frames | resident, MB |\n|---:|---:|", flush=True)
            most = 0
            for mark in [100, *range(500, number + 1, 500)]:
                while process.poll() is None and not list(results.glob(f"ar/*/frames/{mark - 1:06d}.npz")):
                    time.sleep(0.2)
                print(f"| {mark} | {_resident(process.pid, 'VmRSS')} |", flush=True)
            while process.poll() is None:
                most = max(most, _resident(process.pid, "VmHWM"))
                time.sleep(0.2)
            print(f"| the most, with video and motion | {most} |")


def _resident(pid: int, key: str) -> int:
    """A line of a process's status, MB; 0 once it is over."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) // 1024 for line in lines if line.startswith(f"{key}:"))


def _is_flipped(joints: np.ndarray, true: np.ndarray) -> bool:
    """Whether joints `(24, 3)` are nearer to the true ones with left and right exchanged."""
    right, wrong = (np.linalg.norm(each - true, axis=-1).mean() for each in (joints, joints[list(MIRROR)]))
    return bool(wrong < right)


if __name__ == "__main__":
    main()
