"""Plain `.npz` files of poses, with or without shapes and subjects."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from datamodules.sources.fields import RATES, betas_of, gender_of, pose_of, rate_of, read_fields, text_of
from datamodules.sources.recorded import RecordedSource
from datamodules.sources.recordings import Motion, by_clip
from ljn.geometry.rotations import smpl_pose_to_body_world

_OPTIONAL = ("betas", "subject", "clip", "clips", "frame", "gender", *RATES)
_UP = ("y", "z")


class NpzSource(RecordedSource):
    """Poses of `.npz` files, or of one; settings are those of `RecordedSource`.

    Fields: `poses` `(T, 72)`, or what AMASS has; if there are any, `betas` `(B,)` or `(T, B)`; `subject`, `clip` and
    `gender`, one or `(T,)`; `frame` `(T,)`; `frame_rate`. `clip` may be numbers of names in `clips`. Without `subject`,
    it is the clip's name up to a `_`; without `clip`, too, the file's place says it.

    Args:
        up: `y` where poses lead into SMPL's own axes (y up, z forward), `z` where into a world that is z up.
        settings: See `RecordedSource`.
    """

    name = "npz"
    suffix = ".npz"
    other_axes = "data.source.up=z reads those that are z up, up=y those that are y up"
    licence = "files of poses that the user brought; their licence is not known here"

    def __init__(self, path: str | Path | None = None, up: str = "y", **settings: Any) -> None:
        super().__init__(path, **settings)
        if up not in _UP:
            raise ValueError(f"up: expected one of {', '.join(_UP)}, got {up!r}")
        self.up = up

    @property
    def reader_settings(self) -> str:
        """See `RecordedSource.reader_settings`."""
        return f"{super().reader_settings} {self.up}"

    def read(self, path: Path) -> list[Motion]:
        """See `RecordedSource.read`."""
        fields = read_fields(path, ("poses",), _OPTIONAL)
        poses = pose_of(fields["poses"])
        if self.up == "y":
            with np.errstate(all="ignore"):
                poses = smpl_pose_to_body_world(torch.from_numpy(poses)).numpy()
        number = len(poses)
        clip = _column(fields, "clip", number)
        if clip is not None and "clips" in fields:
            names = text_of(fields["clips"])
            try:
                clip = [names[int(code)] for code in clip]
            except (ValueError, IndexError, OverflowError) as error:
                raise ValueError(f"clip: expected numbers of the {len(names)} `clips`, got others") from error
        subject, gender = _column(fields, "subject", number), _column(fields, "gender", number)
        if subject is None and clip is not None:
            subject = [name.split("_")[0] for name in clip]
        frame = _frames(fields, number)
        betas = betas_of(fields["betas"], number) if "betas" in fields else None
        rate = rate_of(fields)
        notes = (
            ("frame_rate: missing, so all frames count",) if self.rate_hz is not None and rate is None else ()
        )
        keys = ["/".join(key) for key in zip(subject or [""] * number, clip or [""] * number)]
        motions: list[Motion] = []
        for key, rows in by_clip(keys):
            rows = rows[self.steps(len(rows), rate)]
            first = rows[0]
            motions.append(
                Motion(
                    poses[rows],
                    np.arange(len(keys))[rows] - rows[0] if frame is None else frame[rows],
                    subject[first] if subject else None,
                    clip[first] if clip else key.strip("/"),
                    gender_of(gender[first]) if gender else None,
                    betas if betas is None or betas.ndim == 1 else betas[rows],
                    notes if not motions else (),
                )
            )
        return motions


def _column(fields: dict[str, np.ndarray], name: str, number: int) -> list[str] | None:
    """A text for each of `number` rows of a field that has one, or as many; None where it is missing."""
    if name not in fields:
        return None
    values = text_of(fields[name])
    if len(values) == 1:
        return values * number
    if len(values) != number or fields[name].ndim > 1:
        raise ValueError(f"{name}: expected one, or one for each of {number} poses, got {fields[name].shape}")
    return values


def _frames(fields: dict[str, np.ndarray], number: int) -> np.ndarray | None:
    if "frame" not in fields:
        return None
    frame = fields["frame"]
    if frame.shape != (number,) or frame.dtype.kind not in "iu":
        raise ValueError(f"frame: expected whole numbers ({number},), got {frame.dtype} of {frame.shape}")
    return frame.astype(np.int64)
