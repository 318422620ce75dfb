"""`task=demo`: the weights that ship, on depth frames that ship, beside the truth."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from ljn.demo import FRAMES
from ljn.metrics import apve, mpjpe
from ljn.pipeline.frames import FrameFiles, FrameImages
from ljn.pipeline.overview import Panel, draw_overview, write_turntable
from ljn.pipeline.pictures import draw_prediction
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.prediction import Prediction
from ljn.pipeline.samples import SampleFiles, Truth, find_samples, read_truth
from ljn.pipeline.writing import write_arrays, write_mesh
from ljn.runs import layout
from ljn.runs.files import write_text_atomically
from ljn.tasks.package import chosen_package
from ljn.tasks.running import use_threads
from ljn.tasks.validation import check_writable

_COMMAND_OF_PREDICT = "python run.py task=predict input=DEPTH.png camera=CAMERA.yaml mask=MASK.png"


class Shown(NamedTuple):
    """A frame, what was found in it without keypoints, and how far that is from the truth.

    Attributes:
        name: The frame's.
        files: The frame's folder.
        prediction: Without keypoints.
        depth: `(H, W)`, metres; 0 is background.
        errors_mm: Of joints (MPJPE) and of vertices (APVE).
        errors_from_keypoints_mm: The same, of a prediction from keypoints.
        milliseconds: The time of the prediction without keypoints.
    """

    name: str
    files: SampleFiles
    prediction: Prediction
    depth: np.ndarray
    errors_mm: tuple[float, float]
    errors_from_keypoints_mm: tuple[float, float]
    milliseconds: float


def demo(cfg: DictConfig) -> dict[str, float]:
    """Predict frames whose truth is known, without keypoints and with them, into `output_dir/demo`.

    Of each frame a picture, arrays (`.npz`) and the mesh (`.glb`), all without keypoints; `overview.png` shows all
    frames, `turntable.gif` the first frame's mesh with its cloud, and a table the errors.

    Args:
        cfg: The composed configuration; of it `task`, `ckpt_path`, `weights`, `refine`, `body.path`, `paths` and
            `num_threads`.

    Returns:
        No metrics: they are in the table, which is printed.

    Raises:
        FileNotFoundError: A checkpoint is missing, or there are no frames.
        ValueError: A checkpoint or a frame is wrong.
    """
    samples = find_samples(cfg.task.directory or FRAMES)
    directory, export = (Path(cfg.paths.output_dir) / name for name in ("demo", "export"))
    check_writable(directory)
    use_threads(cfg)
    pipeline = _pipeline(cfg)
    body_path = cfg.body.path if cfg.task.directory else None

    shown = []
    num_frames = sum(len(files.frames) for files in samples)
    with tqdm(total=num_frames + 3, unit="step", disable=None, leave=False) as progress:
        progress.set_description("getting ready")
        # What is compiled and allocated once is no frame's time.
        _predict(pipeline, samples[0], samples[0].frames[0].read(), with_keypoints=False)
        for files in samples:
            for frame, path in zip(files.frames, files.truths):
                progress.update()
                progress.set_description(frame.name)
                shown.append(_show(pipeline, files, frame, read_truth(path), body_path))
                _write(directory, shown[-1])
        progress.update()
        progress.set_description("overview.png")
        draw_overview([_panel(each) for each in shown]).savefig(directory / "overview.png")
        progress.update()
        progress.set_description("turntable.gif")
        write_turntable(shown[0].prediction, directory / "turntable.gif")
        progress.update()
    table = _table(shown)
    write_text_atomically(directory / layout.TABLE_MARKDOWN, table)
    print(
        f"{table}\nin {directory}: overview.png, turntable.gif; a picture, the mesh (.glb) and arrays of each frame"
    )
    print(f"your own depth image: {_COMMAND_OF_PREDICT}")
    print(
        f"frames of your choice: python run.py task=export; python run.py task=demo task.directory={export}"
    )
    print("networks of your own: make train-demo")
    return {}


def _pipeline(cfg: DictConfig) -> Pipeline:
    """The pipeline of the checkpoints or the package that are given, or of the weights that ship."""
    package = chosen_package(cfg, "ckpt_path", "task.mesh_ckpt_path")
    if package is not None:
        return Pipeline.from_pretrained(package, refine=cfg.refine)
    given = {"ckpt_path": cfg.ckpt_path, "task.mesh_ckpt_path": cfg.task.mesh_ckpt_path}
    if not any(given.values()):
        return Pipeline.from_pretrained(refine=cfg.refine)
    for key, value in given.items():
        if not isinstance(value, str):
            raise ValueError(
                f"{key}: expected a path, got {value!r}; give both ckpt_path=DETECTOR.ckpt and "
                "mesh_ckpt_path=MESH.ckpt, or neither for the weights that ship"
            )
    pipeline = Pipeline.load(cfg.ckpt_path, cfg.task.mesh_ckpt_path, refine=cfg.refine)
    if pipeline.needs_keypoints:
        raise ValueError(
            f"ckpt_path: the detector '{cfg.ckpt_path}' takes keypoints, and the frames are predicted without them; "
            "give a detector that can do without: experiment=detector/cascade"
        )
    return pipeline


def _predict(
    pipeline: Pipeline, files: SampleFiles, images: FrameImages, with_keypoints: bool
) -> tuple[Prediction, np.ndarray]:
    """What is found in a frame, and the body's depth."""
    keypoints = images.keypoints if with_keypoints else None
    observed = pipeline.observe(images.depth, files.camera, keypoints, images.mask)
    return pipeline.predict([observed])[0], observed.depth


def _show(
    pipeline: Pipeline, files: SampleFiles, frame: FrameFiles, truth: Truth, body_path: str | None
) -> Shown:
    """Predict a frame without keypoints and with them, and compare both with the truth."""
    images = frame.read()
    vertices = truth.vertices(body_path)
    started = time.perf_counter()
    prediction, depth = _predict(pipeline, files, images, with_keypoints=False)
    milliseconds = 1000 * (time.perf_counter() - started)
    from_keypoints, _ = _predict(pipeline, files, images, with_keypoints=True)

    def errors_mm(found: Prediction) -> tuple[float, float]:
        assert found.vertices is not None  # the pipeline has a mesh regressor
        joints = found.joints if found.is_refined is None else found.mesh_joints
        pairs = ((mpjpe, joints, truth.joints), (apve, found.vertices, vertices))
        joints_mm, vertices_mm = (
            float(metric(torch.from_numpy(pred), torch.from_numpy(target))) for metric, pred, target in pairs
        )
        return joints_mm, vertices_mm

    return Shown(
        frame.name, files, prediction, depth, errors_mm(prediction), errors_mm(from_keypoints), milliseconds
    )


def _write(directory: Path, shown: Shown) -> None:
    """Write a frame's files."""
    prediction = shown.prediction
    assert prediction.vertices is not None
    assert prediction.faces is not None
    write_arrays(directory / f"{shown.name}.npz", prediction, shown.files.camera)
    write_mesh(directory / f"{shown.name}.glb", prediction.vertices, prediction.faces)
    draw_prediction(prediction, shown.depth, shown.files.camera).savefig(directory / f"{shown.name}.png")


def _panel(shown: Shown) -> Panel:
    joints_mm, vertices_mm = shown.errors_mm
    return Panel(
        shown.prediction,
        shown.depth,
        shown.files.camera,
        title=shown.name,
        subtitle=shown.files.name.replace("_", " "),
        caption=f"joints {joints_mm:.0f} mm, mesh {vertices_mm:.0f} mm",
    )


def _table(shown: list[Shown]) -> str:
    """The errors of all frames and their means, in Markdown."""
    numbers = np.array(
        [[*each.errors_mm, *each.errors_from_keypoints_mm, each.milliseconds] for each in shown]
    )
    rows = [
        [
            "frame",
            "camera",
            "MPJPE, mm",
            "APVE, mm",
            "MPJPE with keypoints",
            "APVE with keypoints",
            "ms a frame",
        ],
        *([each.name, each.files.name, *_texts(row)] for each, row in zip(shown, numbers)),
        ["mean", "", *_texts(numbers.mean(0))],
    ]
    widths = [max(map(len, column)) for column in zip(*rows)]
    rows.insert(
        1, [*("-" * width for width in widths[:2]), *("-" * (width - 1) + ":" for width in widths[2:])]
    )
    return "".join(
        "| "
        + " | ".join([*map(str.ljust, row[:2], widths[:2]), *map(str.rjust, row[2:], widths[2:])])
        + " |\n"
        for row in rows
    )


def _texts(numbers: np.ndarray) -> list[str]:
    *errors, milliseconds = numbers
    return [*(f"{error:.1f}" for error in errors), f"{milliseconds:.0f}"]
