"""AMASS: `.npz` files of the SMPL-H, SMPL+H G and SMPL-X releases."""

from pathlib import Path

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


class AmassSource(RecordedSource):
    """Poses of a folder of AMASS's files; settings are those of `RecordedSource`.

    Of the poses, the 22 joints that all body models share are taken; of the shape, ten coefficients. The world is z up,
    as ours. A subject is the folder that a file is in: `CMU/01`.
    """

    name = "amass"
    suffix = ".npz"
    licence = (
        "AMASS, or files of its form, that the user brought; see the licences of AMASS and of its data sets"
    )

    def is_motion(self, path: Path) -> bool:
        """Whether it is no file of a subject's shape."""
        return path.name != "shape.npz" and not path.stem.endswith("_stagei")

    def read(self, path: Path) -> list[Motion]:
        """See `RecordedSource.read`."""
        fields = read_fields(path, ("poses",), ("betas", "gender", *RATES))
        poses = pose_of(fields["poses"])
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
