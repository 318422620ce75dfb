"""The poses that ship with the project: real motion clips, mirrored and jittered."""

import hashlib
import json
import zipfile
import zlib
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from datamodules.sources import SPLITS, PoseRecords
from ljn.body import GENDERS
from ljn.body.skeleton import MIRROR, NUM_JOINTS, ROOT
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat, smpl_pose_to_body_world

_DATA = Path(__file__).parent / "data"


class EmbeddedSource:
    """Frames of the embedded clips, drawn with the square root of a clip's length as its weight.

    A record is a frame, mirrored left-right with probability one half, every joint but the root turned by a
    small random rotation. Clips belong to one split each (`data/embedded_split.json`), so no test pose has a
    neighbour in training. The recorded heading is dropped: it is drawn at rendering.

    Args:
        jitter_deg: Standard deviation of the jitter about each axis, degrees.
        max_beta: Shape coefficients are standard normal, drawn again where they exceed this: farther out the
            neutral body's chest caves in.
        path: The file of clips; the embedded one by default. `.npz` with `poses` `(N, 72)` in SMPL's rest
            frame (y up, z forward) and `clip` `(N,)` names.
        split_path: JSON file of clip names by split.
    """

    name = "embedded"
    licence = (
        "Motion clips of DeepMimic (from pybullet, zlib licence) and the CMU Graphics Lab Motion Capture "
        "Database (free for research and commercial use); see NOTICE"
    )

    def __init__(
        self,
        jitter_deg: float = 4.0,
        max_beta: float = 2.0,
        path: str | Path | None = None,
        split_path: str | Path | None = None,
    ) -> None:
        if max_beta <= 0:
            raise ValueError(f"max_beta: expected more than 0, got {max_beta}")
        self.jitter_deg = jitter_deg
        self.max_beta = max_beta
        self.path = Path(path or _DATA / "seed_poses.npz")
        if path is not None:
            self.name = f"clips of {self.path.name}"
            self.licence = f"the user's own file {self.path.name}; its licence is not known here"
        self.split_path = Path(split_path or _DATA / "embedded_split.json")

    def check(self) -> None:
        """Read the files; see `PoseSource.check`."""
        _ = self._clips, self._split

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`."""
        digest = hashlib.sha256(self.path.read_bytes() + self.split_path.read_bytes())
        digest.update(f"{self.jitter_deg} {self.max_beta}".encode())
        return digest.hexdigest()[:16]

    @cached_property
    def _clips(self) -> tuple[np.ndarray, np.ndarray]:
        if not self.path.is_file():
            raise FileNotFoundError(f"poses: no file {self.path}; leave `path` out to use the embedded clips")
        try:
            if not zipfile.is_zipfile(self.path):
                raise ValueError("not a .npz archive")
            with np.load(self.path, allow_pickle=False) as file:
                poses, clip = file["poses"].astype(np.float32), file["clip"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(
                f"poses: {self.path} cannot be read ({error}); expected an .npz file with `poses` (N, 72) and "
                "`clip` (N,) names"
            ) from error
        if poses.ndim != 2 or poses.shape[1] != 3 * NUM_JOINTS or clip.shape != poses.shape[:1]:
            raise ValueError(
                f"poses: {self.path} holds `poses` of shape {poses.shape} and `clip` of {clip.shape}; expected "
                f"(N, {3 * NUM_JOINTS}) axis-angle values of the 24 SMPL joints and (N,)"
            )
        if not np.isfinite(poses).all():
            raise ValueError(f"poses: {self.path} holds NaN or infinite values; drop or repair those frames")
        return poses, clip

    @cached_property
    def _split(self) -> dict[str, list[str]]:
        if not self.split_path.is_file():
            raise FileNotFoundError(f"poses: no split file {self.split_path}")
        try:
            split = json.loads(self.split_path.read_text())
        except ValueError as error:
            raise ValueError(f"poses: {self.split_path} is no JSON file ({error})") from error
        is_table = isinstance(split, dict) and all(isinstance(clips, list) for clips in split.values())
        if not is_table or set(split) != set(SPLITS):
            raise ValueError(
                f"poses: {self.split_path} must hold a list of clips for each of {', '.join(SPLITS)}"
            )
        named = [clip for name in SPLITS for clip in split[name]]
        unknown = sorted(set(named) - set(self._clips[1].tolist()))
        if unknown or len(named) != len(set(named)):
            raise ValueError(
                f"poses: {self.split_path} must list each clip under one of {', '.join(SPLITS)}; unknown clips: "
                f"{unknown or 'none'}, clips named twice: {sorted({c for c in named if named.count(c) > 1}) or 'none'}"
            )
        return split

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """See `PoseSource.records`."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, got '{split}'")
        rng = np.random.default_rng([seed, SPLITS.index(split)])
        poses, clip = self._clips
        clips = self._split[split]
        if not clips:
            raise ValueError(f"split: {self.split_path} lists no clips for '{split}'")
        weight = np.sqrt([np.count_nonzero(clip == name) for name in clips])
        chosen = rng.choice(len(clips), num_records, p=weight / weight.sum())
        row = np.empty(num_records, np.int64)
        frame = np.empty(num_records, np.int64)
        position = rng.random(num_records)
        for number, name in enumerate(clips):
            rows, picks = np.flatnonzero(clip == name), np.flatnonzero(chosen == number)
            frame[picks] = (position[picks] * len(rows)).astype(np.int64)
            row[picks] = rows[frame[picks]]

        rotvec = torch.from_numpy(poses[row]).double().unflatten(-1, (NUM_JOINTS, 3))
        mirrored = rotvec[:, list(MIRROR)] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        is_mirrored = torch.from_numpy(rng.random(num_records) < 0.5)
        rotvec = torch.where(is_mirrored[:, None, None], mirrored, rotvec)
        jitter = torch.from_numpy(rng.standard_normal((num_records, NUM_JOINTS, 3))) * np.deg2rad(
            self.jitter_deg
        )
        jitter[:, ROOT] = 0
        rotvec = rotmat_to_rotvec(rotvec_to_rotmat(rotvec) @ rotvec_to_rotmat(jitter))
        pose = without_heading(smpl_pose_to_body_world(rotvec.flatten(-2)))

        betas = rng.standard_normal((num_records, 10))
        while (outside := np.abs(betas) > self.max_beta).any():
            betas[outside] = rng.standard_normal(np.count_nonzero(outside))
        return PoseRecords(
            pose=pose.float().numpy(),
            betas=betas.astype(np.float32),
            gender=np.full(num_records, GENDERS["neutral"]),
            sequence=np.asarray(clips)[chosen],
            frame=frame,
            has_heading=False,
        )


def without_heading(pose: torch.Tensor) -> torch.Tensor:
    """Turn poses `(..., 72)` of the body world about the vertical until the pelvis faces along x."""
    root = rotvec_to_rotmat(pose[..., :3])
    forward = root[..., :, 2]  # SMPL's rest frame looks along z
    heading = torch.atan2(forward[..., 1], forward[..., 0])
    return torch.cat([rotmat_to_rotvec(rotation_about("z", -heading) @ root), pose[..., 3:]], -1)
