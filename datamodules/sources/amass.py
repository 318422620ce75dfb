"""AMASS: `.npz` files of the SMPL-H, SMPL+H G and SMPL-X releases."""

import re
from pathlib import Path

import numpy as np

from datamodules.sources.fields import (
    RATES,
    betas_of,
    gender_of,
    pose_of,
    rate_of,
    read_fields,
    text_of,
)
from datamodules.sources.recorded import RecordedSource
from datamodules.sources.recordings import Motion

_ACCAD = re.compile(r"((?:Fem|M)ale\d)[A-Z]\w+_c3d$|MartialArtsWalksTurns_c3d$")
_PARTS = ("root_orient", "pose_body")
_DATE = re.compile(r"^20\d{6}_(?=.)")


class AmassSource(RecordedSource):
    """Poses of a folder of AMASS's files; settings are those of `RecordedSource`.

    Of the poses, the 22 joints that all body models share are taken; of the shape, ten coefficients. The world is z up,
    as ours. A subject is the two folders that a file is in, `CMU/01`, whichever folder above is `path`.
    """

    name = "amass"
    suffix = ".npz"
    other_axes = "AMASS's own are z up; those that are y up reads data/source=npz"
    licence = (
        "AMASS, or files of its form, that the user brought; see the licences of AMASS and of its data sets"
    )

    def is_motion(self, path: Path) -> bool:
        """Whether it is no file of a subject's shape."""
        return path.name != "shape.npz" and not path.stem.endswith("_stagei")

    def subject_of(self, file: Path, root: Path) -> str:
        """See `RecordedSource.subject_of`; ACCAD and DanceDB have several folders of a person."""
        if file.parent == (root.parent if root.is_file() else root):
            return super().subject_of(file, root)
        *_, above, folder = ("", *file.absolute().parent.parts)
        if (person := _ACCAD.match(folder)) is not None:
            folder = person[1] or "Male2"
        return f"{above}/{_DATE.sub('', folder)}"

    def read(self, path: Path) -> list[Motion]:
        """See `RecordedSource.read`."""
        fields = read_fields(path, (), ("betas", "gender", *RATES))
        poses = pose_of(_poses_in(path))
        rate = rate_of(fields)
        frame = self.steps(len(poses), rate)
        notes = [] if rate else ["mocap_framerate: missing, so all frames count"]
        gender = None
        try:
            gender = gender_of(text_of(fields["gender"])[0])
        except (KeyError, IndexError):
            notes.append("gender: missing, or a Python object; it is drawn")
        except ValueError as error:
            notes.append(f"{error}; it is drawn")
        betas = None
        if "betas" in fields:
            betas = betas_of(fields["betas"], len(poses))
            betas = betas if betas.ndim == 1 else betas[frame]
        else:
            notes.append("betas: missing; they are drawn")
        return [Motion(poses[frame], frame, gender=gender, betas=betas, notes=tuple(notes))]


def _poses_in(path: Path) -> np.ndarray:
    """`poses`, or what SMPL-X's files have of it where that is missing."""
    try:
        return read_fields(path, ("poses",), ())["poses"]
    except ValueError as error:
        if "no such field" not in str(error):
            raise
        try:
            parts = read_fields(path, _PARTS, ())
        except ValueError:
            raise error from None
    shapes = [parts[name].shape for name in _PARTS]
    if shapes != [(len(parts[_PARTS[0]]), width) for width in (3, 63)]:
        raise ValueError(f"{', '.join(_PARTS)}: expected shapes (T, 3) and (T, 63), got {shapes}")
    return np.concatenate([parts[name] for name in _PARTS], 1)
