"""The poses that ship with the project: real motion clips, recombined, and procedural families."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.clips import Clips, read_clips, read_split
from datamodules.sources.embedded.joint_limits import with_square_elbows
from datamodules.sources.embedded.mixture import MixtureSettings, PoseMixture
from datamodules.sources.embedded.recombination import Made, clip_donors
from ljn.body import GENDERS, BodyModel, load_body_model
from ljn.body.skeleton import NUM_JOINTS
from ljn.data import EMBEDDED_DATA_VERSION
from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat, smpl_pose_to_body_world

_DATA = Path(__file__).parent / "data"
_FIRST_BATCH, _LARGEST_BATCH = 128, 2048  # each is twice the one before: small requests are quick as well
_POSES, _SHAPES = range(2)  # streams of a batch
_DECIMALS = 5  # radians; turns the farthest vertex by 0.02 mm

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

    Records come in batches with streams of their own, so a longer request begins with the records of a shorter one.
    All is computed in float64 and poses are rounded to 1e-5 radians: machines whose sines differ in the last bit still
    give equal records and an equal `PoseRecords.hash`, but for the rare value that lies just between two steps.

    Args:
        jitter_deg: Standard deviation of the jitter of whole and recombined poses about each axis, degrees.
        max_beta: Shape coefficients are standard normal, drawn again where they exceed this.
        genders: Genders to draw from, keys of `ljn.body.GENDERS`, each equally often.
        path: The file of clips; the embedded one by default. `.npz` with `poses` `(N, 72)` in SMPL's rest
            frame (y up, z forward) and `clip` `(N,)` names.
        split_path: JSON file of clip names by split; see `read_split`.
        shares: See `MixtureSettings`.
        families: See `MixtureSettings`.
        blend_share: See `MixtureSettings`.
        apart_share: See `MixtureSettings`.
        max_penetration_m: See `MixtureSettings`.
    """

    name = "embedded"
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
        if max_beta <= 0:
            raise ValueError(f"max_beta: expected more than 0, got {max_beta}")
        if not genders or set(genders) - set(GENDERS):
            raise ValueError(f"genders: expected some of {', '.join(GENDERS)}, got {list(genders)}")
        self.settings = MixtureSettings(
            shares=dict(shares),
            families=dict(families),
            blend_share=blend_share,
            apart_share=apart_share,
            jitter_deg=jitter_deg,
            max_penetration_m=max_penetration_m,
        )
        self.max_beta = max_beta
        self.genders = tuple(genders)
        self.path = Path(path or _DATA / "seed_poses.npz")
        if path is not None:
            self.name = f"clips of {self.path.name}"
            self.licence = f"the user's own file {self.path.name}; its licence is not known here"
        self.split_path = Path(split_path or _DATA / "embedded_split.json")
        self._mixtures: dict[str, PoseMixture] = {}

    def check(self) -> None:
        """Read the files; see `PoseSource.check`."""
        _ = self._clips, self._split, self._body

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`."""
        settings = asdict(self.settings) | {
            "version": EMBEDDED_DATA_VERSION,
            "body": self._body.hash,
            "max_beta": self.max_beta,
            "genders": self.genders,
        }
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
        """Whatever bodies the poses are worn by, they are made on one."""
        return load_body_model()

    def motion(self, split: str) -> dict[str, int]:
        """See `PoseSource.motion`: the clips that a frame or a part of a pose can come from."""
        if not any(share for kind, share in self.settings.shares.items() if kind != "procedural"):
            return {"clips": 0, "frames": 0}
        return {"clips": len(self._split[split]), "frames": int(self._is_donor(split).sum())}

    def _is_donor(self, split: str) -> np.ndarray:
        """Whether each frame belongs to a split."""
        return np.isin(self._clips.clip, self._split[split])

    def mixture(self, split: str) -> PoseMixture:
        """The mixture of a split (one of `SPLITS`), whose donors are that split's clips."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        if not self._split[split]:
            raise ValueError(f"split: {self.split_path} lists no clips for '{split}'")
        if split not in self._mixtures:
            is_donor = self._is_donor(split)
            rotvec = torch.from_numpy(self._clips.poses[is_donor]).double().unflatten(-1, (NUM_JOINTS, 3))
            rotmat = with_square_elbows(rotvec_to_rotmat(rotvec))
            donors = clip_donors(rotmat, self._clips.clip[is_donor])
            self._mixtures[split] = PoseMixture(self.settings, donors, self._body)
        return self._mixtures[split]

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        mixture = self.mixture(split)
        batches: list[tuple[np.ndarray, ...]] = []
        size, num_drawn = _FIRST_BATCH, 0
        while not batches or num_drawn < num_records:
            batches.append(self._batch(mixture, [seed, SPLITS.index(split), len(batches)], size))
            num_drawn += size
            size = min(2 * size, _LARGEST_BATCH)
        columns = [np.concatenate(column)[:num_records] for column in zip(*batches)]
        pose, betas, gender, sequence, frame = columns
        return PoseRecords(pose, betas, gender, sequence.astype(str), frame, has_heading=False)

    def _batch(self, mixture: PoseMixture, key: list[int], size: int) -> tuple[np.ndarray, ...]:
        """The columns of `size` records, but for `has_heading`."""
        made = mixture.draw(np.random.default_rng([*key, _POSES]), size)
        rng = np.random.default_rng([*key, _SHAPES])
        gender = rng.choice([GENDERS[name] for name in self.genders], size)
        betas = rng.standard_normal((size, 10))
        while (outside := np.abs(betas) > self.max_beta).any():
            betas[outside] = rng.standard_normal(np.count_nonzero(outside))
        return _to_pose(made), betas.astype(np.float32), gender, made.name, made.frame


def _to_pose(made: Made) -> np.ndarray:
    """Poses `(n, 72)` float32 in body world, in steps of 1e-5 radians."""
    pose = smpl_pose_to_body_world(rotmat_to_rotvec(made.rotmat).flatten(-2))
    return pose.numpy().round(_DECIMALS).astype(np.float32)
