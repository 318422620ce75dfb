"""What the system leaves on disk: a file and a picture for each frame, as soon as it is done, and what is made of all.

A call that is cut off leaves what it has done; the same call goes on after it. Of a live sensor numbers may be missing:
those of frames for which there was no time.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ljn.pipeline.prediction import Prediction
from ljn.reading import READ_ERRORS, read_arrays
from ljn.runs.files import path_part, read_json, write_atomically, write_json
from ljn.system.system import ArResult

_LOG = logging.getLogger(__name__)
_SETTINGS = "settings.json"
_FRAMES, _PICTURES = "frames", "pictures"
_LEFT_OUT = ("points", "vertices", "faces", "initial_joints")  # large, or made again from the parameters
_JPEG_QUALITY = 92
_STATE = "state_"


class StoredFrame(NamedTuple):
    """What is kept of a frame.

    Attributes:
        number: Its place in the recording.
        name: Its name.
        about: `error`, `flip`, `timestamp_s`, `seconds`, `facts`, `warnings`, and what else was said of it.
        arrays: The prediction's arrays without cloud and mesh; `mask` `(H, W)` bool.
        state: The system's after it.
    """

    number: int
    name: str
    about: dict[str, Any]
    arrays: dict[str, np.ndarray]
    state: dict[str, np.ndarray]

    @property
    def prediction(self) -> Prediction | None:
        """The prediction, without cloud and mesh; None of a frame that failed."""
        if "joints" not in self.arrays:
            return None
        arrays: dict[str, Any] = {name: value for name, value in self.arrays.items() if name != "mask"}
        return Prediction(points=np.zeros((0, 6), np.float32), **arrays)


class Store:
    """The files of a recording's frames below a directory.

    Args:
        directory: The directory.
        settings: What the results depend on. What a call with others left there is removed.
        reads: Whether what a call with the same settings left there is kept.
    """

    def __init__(self, directory: Path, settings: Mapping[str, Any], reads: bool = True) -> None:
        self.directory = directory
        self.frames, self.pictures = directory / _FRAMES, directory / _PICTURES
        settings = json.loads(json.dumps(settings))  # as it will be read again
        is_same = reads and read_json(directory / _SETTINGS) == settings
        if reads and not is_same and (directory / _SETTINGS).is_file():
            _LOG.info("%s begins anew: settings, weights or the recording's files have changed", directory)
        self._numbers = self._found() if is_same else []
        kept = {f"{number:06d}" for number in self._numbers}
        for folder in (self.frames, self.pictures):
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.iterdir():
                if path.stem.partition("-")[0] not in kept:
                    path.unlink()
        if not is_same:
            write_json(directory / _SETTINGS, settings)

    def _found(self) -> list[int]:
        """The numbers of the frames that are there, up to the first that is missing."""
        number = 0
        while (self.frames / f"{number:06d}.npz").is_file():
            number += 1
        return list(range(number))

    def write(
        self, result: ArResult, picture: np.ndarray, state: Mapping[str, np.ndarray], about: Mapping[str, Any]
    ) -> None:
        """Write a frame.

        Args:
            result: What became of it.
            picture: `(H, W, 3)` uint8.
            state: The system's after it.
            about: What else is to be said of it; plain values.
        """
        import cv2

        stem = f"{result.frame.number:06d}"
        said = {
            "number": result.frame.number,
            "name": result.frame.name,
            "timestamp_s": result.frame.timestamp_s,
            "error": result.error,
            "flip": result.flip,
            "seconds": result.seconds,
            "facts": result.facts,
            "warnings": result.warnings,
            **about,
        }
        arrays = {} if result.prediction is None else dict(result.prediction.arrays)
        arrays = {name: value for name, value in arrays.items() if name not in _LEFT_OUT}
        if result.mask is not None:
            arrays["mask"] = result.mask
        arrays |= {f"{_STATE}{name}": value for name, value in state.items()}
        _, encoded = cv2.imencode(
            ".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )
        write_atomically(self.pictures / f"{stem}-{path_part(result.frame.name)}.jpg", encoded.tobytes())
        draft = self.frames / f".{stem}.npz"
        np.savez_compressed(draft, about=np.array(json.dumps(said)), **arrays)  # type: ignore[arg-type]
        draft.replace(self.frames / f"{stem}.npz")  # the last: with it, the frame is done
        self._numbers.append(result.frame.number)

    @property
    def num_done(self) -> int:
        """How many frames are done."""
        return len(self._numbers)

    def read(self, number: int) -> StoredFrame:
        """A frame.

        Raises:
            ValueError: Its file is damaged.
        """
        path = self.frames / f"{number:06d}.npz"
        try:
            arrays = read_arrays(path)
            about = json.loads(str(arrays.pop("about")))
        except READ_ERRORS as error:
            raise ValueError(f"'{path}' is damaged; remove it, and give the same command again") from error
        state = {
            name.removeprefix(_STATE): arrays.pop(name) for name in list(arrays) if name.startswith(_STATE)
        }
        return StoredFrame(about.pop("number"), about.pop("name"), about, arrays, state)

    def stored(self) -> Iterator[StoredFrame]:
        """The frames that are done, in order, one at a time."""
        for number in self._numbers:
            yield self.read(number)

    def read_pictures(self, number: int | None = None) -> Iterator[np.ndarray]:
        """The pictures `(H, W, 3)` uint8 of the frames that are done, in order, one at a time.

        Args:
            number: So many of them, spread evenly; None: all.
        """
        import cv2

        of_number = {path.stem.partition("-")[0]: path for path in self.pictures.glob("*.jpg")}
        paths = [of_number[f"{done:06d}"] for done in self._numbers]
        if number is not None and len(paths) > number:
            paths = [paths[round(i * (len(paths) - 1) / (number - 1))] for i in range(number)]
        for path in paths:
            picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if picture is None:
                raise ValueError(f"'{path}' is damaged; remove the folder, and give the same command again")
            yield picture[..., ::-1]
