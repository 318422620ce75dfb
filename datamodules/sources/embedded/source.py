"""The poses that ship with the project: real motion clips, recombined, and procedural families."""

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

from datamodules.sources import PoseRecords
from datamodules.sources.clips import Clips, read_clips, read_split
from datamodules.sources.embedded.mixture import MixtureSettings
from datamodules.sources.embedded.records import POSES_VERSION, ClipMixture
from datamodules.sources.shapes import check_shapes
from ljn.body import BodyModel, load_body_model

_DATA = Path(__file__).parent / "data"

SHARES: Mapping[str, float] = {"whole": 0.30, "swapped": 0.20, "mixed": 0.20, "procedural": 0.30}
FAMILY_SHARES: Mapping[str, float] = {
    "stand": 0.16, "walk": 0.13, "run": 0.04, "squat": 0.09, "lunge": 0.08, "sit": 0.08, "kick": 0.07,
    "kneel": 0.05, "crawl": 0.04, "lie": 0.04, "dance": 0.16, "climb": 0.06,
}  # fmt: skip


class EmbeddedSource:
    """Poses made from the embedded clips and from procedural families, within human limits.

    A record is a frame of a clip (mirrored left-right half the time, jittered), or legs, trunk and arms of several
    donors, or a draw from a family of postures. Joints are held within ranges of motion, and a pose that reaches into
    itself is drawn again. Clips belong to one split each (`data/embedded_split.json`), so no test pose has a neighbour
    or a donor in training. Headings are dropped: they are drawn at rendering.

    `sequence` says where a record comes from: a clip; "legs|trunk|arms", or "legs|trunk|left arm|right arm", with
    "one+other" for a part between two donors; or "proc/" and a family. `frame` is the frame of the (legs') clip, -1
    without one.

    How records are drawn is `ClipMixture`'s.

    Args:
        jitter_deg: Standard deviation of the jitter of whole and recombined poses about each axis, degrees.
        max_beta: Shape coefficients are standard normal, drawn again where they exceed this.
        genders: Genders to draw from, keys of `ljn.body.GENDERS`, each equally often.
        path: The file of clips; the embedded one by default. `.npz` with `poses` `(N, 72)` in SMPL's rest
            frame (y up, z forward) and `clip` `(N,)` names.
        split_path: JSON file of clip names by split; see `read_split`.
        shares, families, blend_share, apart_share, max_penetration_m: See `MixtureSettings`.
    """

    name = "embedded"
    version = POSES_VERSION
    cache_dir: Path | None = None
    licence = (
        "Motion clips of DeepMimic (from pybullet, zlib licence) and the CMU Graphics Lab Motion Capture "
        "Database (free for research and commercial use); see NOTICE"
    )

    def __init__(
        self,
        jitter_deg: float = 4.0,
        max_beta: float = 3.0,
        genders: Sequence[str] = ("female", "male"),
        path: str | Path | None = None,
        split_path: str | Path | None = None,
        shares: Mapping[str, float] = SHARES,
        families: Mapping[str, float] = FAMILY_SHARES,
        blend_share: float = 0.3,
        apart_share: float = 0.5,
        max_penetration_m: float = 0.05,
    ) -> None:
        check_shapes(genders, max_beta)
        numbers = (blend_share, apart_share, jitter_deg, max_penetration_m)
        self.settings = MixtureSettings(dict(shares), dict(families), *numbers)
        self.max_beta = max_beta
        self.genders = tuple(genders)
        self.path = Path(path or _DATA / "seed_poses.npz")
        if path is not None:
            self.name = f"clips of {self.path.name}"
            self.licence = f"the user's own file {self.path.name}; its licence is not known here"
        self.split_path = Path(split_path or _DATA / "embedded_split.json")

    def check(self) -> None:
        """Read the files; see `PoseSource.check`."""
        _ = self._clips, self._split, self._body

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`."""
        shapes = {"body": self._body.hash, "max_beta": self.max_beta, "genders": self.genders}
        settings = asdict(self.settings) | {"version": self.version, **shapes}
        digest = hashlib.sha256(self.path.read_bytes() + self.split_path.read_bytes())
        digest.update(json.dumps(settings, sort_keys=True).encode())
        return digest.hexdigest()[:16]

    @cached_property
    def _clips(self) -> Clips:
        return read_clips(self.path)

    @cached_property
    def _split(self) -> dict[str, list[str]]:
        return read_split(self.split_path, self._clips)

    @cached_property
    def _body(self) -> BodyModel:
        """The one body that poses are made on, whatever bodies are rendered in them."""
        return load_body_model()

    @cached_property
    def mixture(self) -> ClipMixture:
        """The clips, mixed."""
        return ClipMixture(self._clips, self._split, self.settings, self._body, self.max_beta, self.genders)

    def people(self, split: str) -> list[tuple[str, str]]:
        """See `datamodules.sources.mixed.Peopled`: CMU's subjects, whose clips are numbers such as `01_03`."""
        found = [re.fullmatch(r"0*(\d+)_\d+", clip) for clip in self._split[split]]
        return sorted({("CMU", match[1]) for match in found if match})

    def motion(self, split: str) -> dict[str, int]:
        """See `PoseSource.motion`."""
        return self.mixture.motion(split)

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        return self.mixture.records(split, num_records, seed)
