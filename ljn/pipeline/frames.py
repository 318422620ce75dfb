"""Frames one after another, from files or a camera; one that fails does not stop the others."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count, islice, pairwise
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import DEPTH_SUFFIXES, RGB_SUFFIXES, read_depth, read_keypoints, read_mask, read_rgb
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.prediction import Prediction

FrameT = TypeVar("FrameT")

_OPENPOSE_VIDEO = re.compile(r"(?P<stem>.+)_(?P<number>[0-9]{12})_keypoints\.json")
_LAST_NUMBER = re.compile(r"[0-9]+$")


class FrameImages(NamedTuple):
    """What is known of one image; each part as `Pipeline` takes it."""

    depth: Any  # `(H, W)`
    keypoints: Any
    mask: Any = None  # `(H, W)`; None for none
    rgb: Any = None  # `(H, W, 3)`; None for none


class FrameFiles(NamedTuple):
    """The files of one image."""

    name: str  # names its outputs
    depth: Path
    keypoints: Path | None
    mask: Path | None
    mask_id: int | None = None  # of an index map, the person's number
    rgb: Path | None = None

    def read(self) -> FrameImages:
        """What the files hold.

        Raises:
            FileNotFoundError: One is missing.
            ValueError: One cannot be read.
        """
        mask = None if self.mask is None else read_mask(self.mask, self.mask_id)
        keypoints = None if self.keypoints is None else read_keypoints(self.keypoints)
        rgb = None if self.rgb is None else read_rgb(self.rgb)
        return FrameImages(read_depth(self.depth), keypoints, mask, rgb)


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
                observed = pipeline.observe(
                    images.depth, camera, images.keypoints, images.mask, rgb=images.rgb
                )
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
    input: str | Path,
    keypoints: str | Path | None = None,
    mask: str | Path | None = None,
    mask_id: int | None = None,
    rgb: str | Path | None = None,
) -> list[FrameFiles]:
    """The frames of a depth image, or of a folder of them; with keypoints, masks and colour images of the same stem.

    Keypoints may also be named as OpenPose does: `STEM_keypoints.json`; `STEM_000000000012_keypoints.json`, if that is
    the only one of its stem; or, of a video, any name with the number of a frame, if these are those that the depth
    images' names end with.

    Raises:
        FileNotFoundError: There is no such file or folder, or no depth image in it.
        ValueError: Files and folders are mixed, or two depth images share a stem.
    """
    given = {"input": input, "keypoints": keypoints, "mask": mask, "rgb": rgb}
    paths = {name: Path(path) for name, path in given.items() if path}
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(f"{name}: no file or folder '{path}'")
    if len({path.is_dir() for path in paths.values()}) > 1:
        kinds = (f"{name} is a {'folder' if path.is_dir() else 'file'}" for name, path in paths.items())
        raise ValueError(f"{', '.join(paths)}: expected files or folders alike, got: {', '.join(kinds)}")
    if not paths["input"].is_dir():
        return [
            FrameFiles(
                *(paths["input"].stem, paths["input"], paths.get("keypoints"), paths.get("mask")),
                *(mask_id, paths.get("rgb")),
            )
        ]
    images = sorted(path for path in paths["input"].iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    if not images:
        raise FileNotFoundError(f"input: no depth image ({', '.join(DEPTH_SUFFIXES)}) in '{paths['input']}'")
    for before, path in pairwise(images):
        if before.stem == path.stem:
            raise ValueError(
                f"input: '{before.name}' and '{path.name}' would write the same outputs; rename one"
            )
    of_stem = _keypoint_files(paths["keypoints"], [path.stem for path in images]) if keypoints else {}
    return [
        FrameFiles(
            path.stem,
            path,
            of_stem.get(path.stem),
            paths["mask"] / f"{path.stem}.png" if mask else None,
            mask_id,
            _rgb_file(paths["rgb"], path.stem) if rgb else None,
        )
        for path in images
    ]


def in_order(name: str) -> list[tuple[int, str]]:
    """What to sort a frame's name by, so that `frame_9` comes before `frame_10`."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts]


def _rgb_file(folder: Path, stem: str) -> Path:
    """The colour image of a depth image; where there is none, that which would be read first."""
    choices = [folder / f"{stem}{suffix}" for suffix in RGB_SUFFIXES]
    return next((path for path in choices if path.is_file()), choices[0])


def _keypoint_files(folder: Path, stems: Sequence[str]) -> dict[str, Path]:
    """The file of each depth image's keypoints, by stem; where there is none, that which would be read first."""
    names = {path.name for path in folder.iterdir() if path.suffix == ".json"}
    by_number: dict[int, list[str]] = {}
    by_stem: dict[str, list[str]] = {}
    for name in sorted(names):
        if match := _OPENPOSE_VIDEO.fullmatch(name):
            by_stem.setdefault(match["stem"], []).append(name)
            by_number.setdefault(int(match["number"]), []).append(name)
    numbers = [int(match[0]) if (match := _LAST_NUMBER.search(stem)) else None for stem in stems]
    # One file for each number and one image for each: anything else could be another video's.
    is_numbered = set(numbers) == by_number.keys() and len(set(numbers)) == len(stems) == sum(
        map(len, by_number.values())
    )
    found = {}
    for stem, number in zip(stems, numbers):
        choices = [name for name in (f"{stem}.json", f"{stem}_keypoints.json") if name in names]
        if len(of_stem := by_stem.get(stem, [])) == 1:
            choices += of_stem
        if is_numbered and number is not None:
            choices += by_number[number]
        found[stem] = folder / (choices or [f"{stem}.json"])[0]
    return found
