"""Frames one after another, from files or a camera; one that fails does not stop the others."""

from collections.abc import Callable, Iterable, Iterator
from itertools import count, islice, pairwise
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import DEPTH_SUFFIXES, read_depth, read_keypoints, read_mask
from ljn.pipeline.pipeline import Pipeline, Prediction

FrameT = TypeVar("FrameT")


class FrameImages(NamedTuple):
    """What is known of one image; each part as `Pipeline` takes it."""

    depth: Any  # `(H, W)`
    keypoints: Any
    mask: Any = None  # `(H, W)`; None for none


class FrameFiles(NamedTuple):
    """The files of one image."""

    name: str  # names its outputs
    depth: Path
    keypoints: Path | None
    mask: Path | None

    def read(self) -> FrameImages:
        """What the files hold.

        Raises:
            FileNotFoundError: One is missing.
            ValueError: One cannot be read.
        """
        mask = None if self.mask is None else read_mask(self.mask)
        keypoints = None if self.keypoints is None else read_keypoints(self.keypoints)
        return FrameImages(read_depth(self.depth), keypoints, mask)


class FrameResult(NamedTuple, Generic[FrameT]):
    """What became of a frame: a prediction, or an error."""

    frame: FrameT
    prediction: Prediction | None = None  # see `Pipeline`; None after an error
    depth: np.ndarray | None = None  # `(H, W)`, the body's, metres; None after an error
    error: Exception | None = None  # what was wrong with it; None otherwise


def predict_frames(
    pipeline: Pipeline,
    frames: Iterable[FrameT],
    camera: Camera,
    read: Callable[[FrameT], FrameImages],
    batch_size: int = 8,
) -> Iterator[FrameResult[FrameT]]:
    """Predict frames of one camera, a batch at a time; yields a result for each frame, in their order.

    Frames have any form and are taken as they are needed; `read` gives their images. Its `FileNotFoundError` and
    `ValueError`, and the pipeline's about a frame's images, become the frame's result. `batch_size` is 1 for a camera,
    whose next frame comes later.
    """
    remaining = iter(frames)
    while batch := list(islice(remaining, batch_size)):
        results, observations = [], []
        for frame in batch:
            try:
                images = read(frame)
                observed = pipeline.observe(images.depth, camera, images.keypoints, images.mask)
                observations.append(observed)
                results.append(FrameResult(frame, depth=observed.depth))
            except (ValueError, FileNotFoundError) as error:
                results.append(FrameResult(frame, error=error))
        predictions = pipeline.predict(observations) if observations else None
        numbers = count()
        for result in results:
            if predictions is not None and result.error is None:
                result = result._replace(prediction=predictions[next(numbers)])
            yield result


def find_frames(
    input: str | Path, keypoints: str | Path | None = None, mask: str | Path | None = None
) -> list[FrameFiles]:
    """The frames of a depth image, or of a folder of them; with keypoints and masks of the same stem in theirs.

    Raises:
        FileNotFoundError: There is no such file or folder, or no depth image in it.
        ValueError: Files and folders are mixed, or two depth images share a stem.
    """
    given = {"input": input, "keypoints": keypoints, "mask": mask}
    paths = {name: Path(path) for name, path in given.items() if path}
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(f"{name}: no file or folder '{path}'")
    if len({path.is_dir() for path in paths.values()}) > 1:
        kinds = (f"{name} is a {'folder' if path.is_dir() else 'file'}" for name, path in paths.items())
        raise ValueError(f"input, keypoints, mask: expected files or folders alike, got: {', '.join(kinds)}")
    if not paths["input"].is_dir():
        return [FrameFiles(paths["input"].stem, paths["input"], paths.get("keypoints"), paths.get("mask"))]
    images = sorted(path for path in paths["input"].iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    if not images:
        raise FileNotFoundError(f"input: no depth image ({', '.join(DEPTH_SUFFIXES)}) in '{paths['input']}'")
    for before, path in pairwise(images):
        if before.stem == path.stem:
            raise ValueError(
                f"input: '{before.name}' and '{path.name}' would write the same outputs; rename one"
            )
    return [
        FrameFiles(
            path.stem,
            path,
            paths["keypoints"] / f"{path.stem}.json" if keypoints else None,
            paths["mask"] / f"{path.stem}.png" if mask else None,
        )
        for path in images
    ]
