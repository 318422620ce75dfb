"""The AR system: a frame of depth and colour in, mask, 2D joints, joints and mesh out, one after another."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch

from ljn.body.skeleton import ROOT
from ljn.geometry.camera import Camera, project
from ljn.geometry.rotations import rotvec_to_rotmat
from ljn.pipeline.keypoints import Keypoints
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.prediction import Prediction
from ljn.pipeline.report import Report
from ljn.system.flips import FlipJudge
from ljn.system.recording import RgbdFrame
from ljn.system.smoothing import PoseSmoother, SmoothingSettings

_FPS = 30.0  # of a recording whose rate nobody knows
_GAP_S = 0.5  # after a longer one, nothing is smoothed over it
_JUDGE, _SMOOTHER, _SEGMENTER = "judge_", "smoother_", "segmenter_"  # what is theirs of the state

Segmenter = Callable[[RgbdFrame, Camera], np.ndarray]
"""Finds the person: a frame and its camera in, a mask `(H, W)` bool out; a `ValueError` where there is none."""


@runtime_checkable
class Following(Protocol):
    """A segmenter that follows the person from frame to frame.

    Attributes:
        state: What it remembers, as arrays by name, to go on from.
        doubts: About who it is, in the last frame.
    """

    state: dict[str, np.ndarray]
    doubts: list[str]


class ArResult(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: It.
        prediction: What was found; None where that failed.
        mask: `(H, W)` bool, the person's pixels; None where that failed.
        error: Why it failed; None otherwise.
        flip: See `ljn.system.flips.Judged`.
        facts: What was found in the input and done about it.
        warnings: Doubts.
        seconds: What each stage took.
    """

    frame: RgbdFrame
    prediction: Prediction | None
    mask: np.ndarray | None
    error: str | None
    flip: str
    facts: dict[str, Any]
    warnings: list[str]
    seconds: dict[str, float]


class ArSystem:
    """Finds one person in frame after frame; a frame that fails is marked, and the others go on.

    Args:
        pipeline: Finds joints and mesh; its keypoint detector, where it has one, the 2D joints.
        camera: The camera of the frames.
        segmenter: Finds the person's pixels; None: depth is 0 everywhere else already, or the person is found by the
            pipeline.
        smoothing: How much is smoothed over time; None: nothing.
        mends_flips: Whether exchanged sides are looked for, and mended.
        fps: Frames a second, for those whose times nobody knows; None: 30.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        camera: Camera,
        segmenter: Segmenter | None = None,
        smoothing: SmoothingSettings | None = None,
        mends_flips: bool = True,
        fps: float | None = None,
    ) -> None:
        self.pipeline = pipeline
        self.camera = camera
        self.segmenter = segmenter
        self.smoother = None if smoothing is None else PoseSmoother(smoothing)
        self.judge = FlipJudge() if mends_flips else None
        self.fps = fps or _FPS
        self._number, self._now_s = 0, 0.0  # of the frame before
        self._smoothed_s: float | None = None  # when the last one was that was smoothed

    def __call__(self, frame: RgbdFrame, keypoints: Any = None) -> ArResult:
        """What is found in a frame; frames come in their order.

        Args:
            frame: The frame.
            keypoints: 2D keypoints, where somebody gives them; see `body_keypoints`.
        """
        watch, report = _Watch(), Report(is_strict=self.pipeline.is_strict)
        seconds = self._time(frame)
        mask = None
        try:
            if frame.error is not None or frame.depth is None:
                raise ValueError(frame.error or "it has no depth image")
            with watch("segmentation"):
                if self.segmenter is not None:
                    mask = self.segmenter(frame._replace(timestamp_s=seconds), self.camera)
                if isinstance(self.segmenter, Following):
                    for doubt in self.segmenter.doubts:
                        report.doubt(doubt)
            with watch("2D joints"):
                observed = self.pipeline.observe(
                    frame.depth, self.camera, keypoints, mask, report, rgb=frame.rgb
                )
            mask = observed.depth > 0
            with watch("joints and mesh"):
                prediction = self.pipeline.predict([observed])[0]
            with watch("flips"):
                flip = ""
                if self.judge is not None:

                    def again(joints: np.ndarray) -> Prediction:
                        return self._from_joints(observed.depth, joints, report)

                    prediction, flip = self.judge(prediction, seconds, again)
            with watch("smoothing"):
                prediction = self._smoothed(prediction, seconds)
        except ValueError as error:
            return ArResult(frame, None, mask, str(error), "", report.facts, report.warnings, watch.seconds)
        return ArResult(frame, prediction, mask, None, flip, report.facts, report.warnings, watch.seconds)

    @property
    def state(self) -> dict[str, np.ndarray]:
        """What it remembers of the frames before, as arrays by name: to go on from."""
        state = {"number": np.array(self._number), "now_s": np.array(self._now_s)}
        if self._smoothed_s is not None:
            state["smoothed_s"] = np.array(self._smoothed_s)
        if self.judge is not None and self.judge.joints is not None:
            state |= {f"{_JUDGE}{name}": np.array(value) for name, value in vars(self.judge).items()}
        if self.smoother is not None:
            state |= {f"{_SMOOTHER}{name}": value for name, value in self.smoother.state.items()}
        if isinstance(self.segmenter, Following):
            state |= {f"{_SEGMENTER}{name}": value for name, value in self.segmenter.state.items()}
        return state

    @state.setter
    def state(self, state: Mapping[str, np.ndarray]) -> None:
        self._number, self._now_s = int(state["number"]), float(state["now_s"])
        self._smoothed_s = float(state["smoothed_s"]) if "smoothed_s" in state else None
        if self.judge is not None:
            values: dict[str, Any] = {
                name: each if each.ndim else each.item() for name, each in _part(state, _JUDGE).items()
            }
            self.judge = FlipJudge(**values)
        if self.smoother is not None:
            self.smoother.state = _part(state, _SMOOTHER)
        if isinstance(self.segmenter, Following):
            self.segmenter.state = _part(state, _SEGMENTER)

    def _time(self, frame: RgbdFrame) -> float:
        """When a frame was taken, seconds: as it says, or so many frames after the one before."""
        seconds = frame.timestamp_s
        if seconds is None:
            seconds = self._now_s + (frame.number - self._number) / self.fps
        self._number, self._now_s = frame.number, seconds
        return seconds

    def _from_joints(self, depth: np.ndarray, joints: np.ndarray, report: Report) -> Prediction:
        """The prediction that begins with the image of joints `(24, 3)`, as if it were given as keypoints."""
        positions = project(torch.from_numpy(joints), self.camera.intrinsics()).numpy()
        keypoints = Keypoints(positions.astype(np.float32), np.ones(len(joints), np.float32))
        observed = self.pipeline.observe_body(depth, self.camera, keypoints)
        return self.pipeline.predict([observed._replace(report=report)])[0]

    @torch.inference_mode()
    def _smoothed(self, prediction: Prediction, seconds: float) -> Prediction:
        """A prediction smoothed over the frames before, its mesh made anew."""
        if self.smoother is None:
            return prediction
        last, self._smoothed_s = self._smoothed_s, seconds
        if last is None or not 0 < seconds - last <= _GAP_S:
            self.smoother.forget()
            last = seconds - 1 / self.fps
        values = {"joints": torch.from_numpy(prediction.joints)}
        if prediction.pose is not None and prediction.mesh_joints is not None:
            rotvecs = torch.from_numpy(prediction.pose).unflatten(-1, (-1, 3))
            values |= {
                "root": torch.from_numpy(prediction.mesh_joints[ROOT]),
                "rotmats": rotvec_to_rotmat(rotvecs),
                "betas": torch.from_numpy(prediction.betas),
            }
        smoothed = self.smoother(values, seconds - last)
        made: dict[str, Any] = {"joints": smoothed["joints"].numpy()}
        if self.pipeline.regressor is not None:
            device = self.pipeline.regressor.module.device
            parameters = [smoothed[name][None].to(device) for name in ("rotmats", "betas", "root")]
            meshes = self.pipeline.meshes(*parameters)
            made |= {name: value[0].cpu().numpy() for name, value in meshes.items() if name != "faces"}
        return replace(prediction, **made)


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


class _Watch:
    """What each stage took, seconds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = time.perf_counter() - begin
