"""From clips to records: poses mixed from clips and procedural families, with drawn shapes and genders."""

from collections.abc import Sequence

import numpy as np
import torch

from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.clips import Clips
from datamodules.sources.embedded.joint_limits import with_square_elbows
from datamodules.sources.embedded.mixture import MixtureSettings, PoseMixture
from datamodules.sources.embedded.recombination import Made, clip_donors
from datamodules.sources.shapes import draw_shapes
from ljn.body import BodyModel
from ljn.body.skeleton import NUM_JOINTS
from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat, smpl_pose_to_body_world

POSES_VERSION = 1
"""Raised with every change of the records made of the same clips and bodies: results are comparable within a version
only. A test holds their hashes."""
_FIRST_BATCH, _LARGEST_BATCH = 128, 2048  # each is twice the one before: small requests are quick as well
_POSES, _SHAPES = range(2)  # streams of a batch
_DECIMALS = 5  # radians; turns the farthest vertex by 0.02 mm


class ClipMixture:
    """Records of any clips, split by clip, posed on one body, whatever bodies are rendered in them.

    Shape coefficients are standard normal, drawn again where they exceed `max_beta`; genders are drawn equally often.

    They come in batches with streams of their own, so a longer request begins with the records of a shorter one. All
    is computed in float64 and poses are rounded to 1e-5 radians: machines whose sines differ in the last bit still
    give equal records and an equal `PoseRecords.hash`, but for the rare value that lies just between two steps.
    """

    def __init__(
        self,
        clips: Clips,
        split: dict[str, list[str]],
        settings: MixtureSettings,
        body: BodyModel,
        max_beta: float,
        genders: Sequence[str],
    ) -> None:
        self.clips = clips
        self.split = split
        self.settings = settings
        self.body = body
        self.max_beta = max_beta
        self.genders = genders
        self._mixtures: dict[str, PoseMixture] = {}

    def motion(self, split: str) -> dict[str, int]:
        """The clips, and their frames, that a frame or a part of a pose can come from."""
        if not any(share for kind, share in self.settings.shares.items() if kind != "procedural"):
            return {"clips": 0, "frames": 0}
        return {"clips": len(self.split[split]), "frames": int(self._is_donor(split).sum())}

    def _is_donor(self, split: str) -> np.ndarray:
        """Whether each frame belongs to a split."""
        return np.isin(self.clips.clip, self.split[split])

    def of(self, split: str) -> PoseMixture:
        """The mixture of a split (one of `SPLITS`), whose donors are that split's clips."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        if not self.split[split]:
            raise ValueError(f"split: the table of splits lists no clips for '{split}'")
        if split not in self._mixtures:
            is_donor = self._is_donor(split)
            rotvec = torch.from_numpy(self.clips.poses[is_donor]).double().unflatten(-1, (NUM_JOINTS, 3))
            rotmat = with_square_elbows(rotvec_to_rotmat(rotvec))
            donors = clip_donors(rotmat, self.clips.clip[is_donor])
            self._mixtures[split] = PoseMixture(self.settings, donors, self.body)
        return self._mixtures[split]

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        mixture = self.of(split)
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
        gender, betas = draw_shapes(rng, size, self.genders, self.max_beta)
        return _to_pose(made), betas.astype(np.float32), gender, made.name, made.frame


def _to_pose(made: Made) -> np.ndarray:
    """Poses `(n, 72)` float32 in body world, in steps of 1e-5 radians."""
    pose = smpl_pose_to_body_world(rotmat_to_rotvec(made.rotmat).flatten(-2))
    return pose.numpy().round(_DECIMALS).astype(np.float32)
