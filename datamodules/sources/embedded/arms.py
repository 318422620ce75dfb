"""Arms posed by where the hand goes: targets, and two-bone inverse kinematics with a swivel angle."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.embedded.joint_limits import ARM_AXES
from ljn.body.kinematics import SIDES
from ljn.body.skeleton import JOINT_INDEX
from ljn.geometry.rotations import euler_to_rotmat, rotation_about


class Goal(NamedTuple):
    """A normal distribution of wrist positions: left arm, from the shoulder, chest's axes, in arm lengths."""

    mean: tuple[float, float, float]  # to the left, up, forward
    deviation: tuple[float, float, float]  # standard deviation along each


GOALS: dict[str, Goal] = {
    "hang": Goal((0.20, -0.93, 0.08), (0.12, 0.07, 0.16)),
    "front": Goal((0.05, -0.25, 0.75), (0.32, 0.32, 0.18)),
    "overhead": Goal((0.10, 0.75, 0.25), (0.25, 0.22, 0.25)),
    "wide": Goal((0.85, -0.05, 0.15), (0.15, 0.35, 0.30)),
    "face": Goal((-0.15, 0.05, 0.35), (0.15, 0.22, 0.10)),
    "hips": Goal((0.25, -0.60, -0.15), (0.15, 0.15, 0.10)),
    "run": Goal((0.08, -0.45, 0.40), (0.10, 0.12, 0.12)),
    "support": Goal((0.05, 0.00, 0.95), (0.12, 0.15, 0.05)),
    "beside": Goal((0.30, -0.88, 0.00), (0.12, 0.08, 0.05)),
    "low": Goal((0.05, -0.85, 0.30), (0.12, 0.08, 0.12)),
    "round": Goal((-0.05, -0.15, 0.75), (0.12, 0.15, 0.10)),
    "side": Goal((0.90, 0.05, 0.20), (0.08, 0.20, 0.20)),
    "high": Goal((0.05, 0.90, 0.15), (0.18, 0.08, 0.18)),
    "flat": Goal((0.70, 0.30, 0.00), (0.25, 0.45, 0.05)),
}
"""Where hands go. `run`: elbows bent, beside the waist. `support`: on the floor, for a trunk that is level. `beside`
and `flat`: on the floor, for a trunk that lies on it, beside the body or anywhere farther up. `low`, `round`, `side`
and `high`: ballet's rounded positions, before the thighs, before the chest, to the side and over the head."""

_REACH = (0.36, 0.985)
"""Distances from the shoulder, in arm lengths: an elbow bends no farther, and is never quite straight."""
_MAX_FLEXION_DEG, _MIN_FLEXION_DEG = 148.0, 4.0


def draw_targets(rng: np.random.Generator, goals: np.ndarray, swing: np.ndarray, drop: np.ndarray) -> Tensor:
    """Wrist positions, to the side, up and forward of the shoulder: `(n, 2, 3)`, arm lengths, left arm first.

    Drawn about `goals` `(n, 2)`, indices into `GOALS`; the left arm swings forward and the right one back by `swing`
    `(n,)`, arm lengths; then all is turned downwards by `drop` `(n,)`, degrees.
    """
    mean = np.array([goal.mean for goal in GOALS.values()])[goals]
    deviation = np.array([goal.deviation for goal in GOALS.values()])[goals]
    target = mean + deviation * rng.standard_normal(mean.shape)
    target[..., 2] += swing[:, None] * np.array([1.0, -1.0])
    cosine, sine = np.cos(np.deg2rad(drop))[:, None], np.sin(np.deg2rad(drop))[:, None]
    side, up, forward = np.moveaxis(target, -1, 0)
    target = np.stack([side, cosine * up - sine * forward, sine * up + cosine * forward], -1)
    distance = np.linalg.norm(target, axis=-1, keepdims=True)
    return torch.from_numpy(target * (distance.clip(*_REACH) / distance.clip(min=1e-6)))


def pose_arms(rng: np.random.Generator, target: Tensor, offsets: Tensor, rotmat: Tensor) -> None:
    """Write both arms' rotations into poses.

    Args:
        rng: Source of the draws: swivel, forearm's turn, wrist, and scatter of the collar.
        target: `(n, 2, 3)`, see `draw_targets`.
        offsets: `(24, 3)`, metres; see `joint_offsets`.
        rotmat: `(n, 24, 3, 3)`, changed in place.
    """

    def scatter(*deviations: float) -> Tensor:
        draws = rng.standard_normal((len(target), len(SIDES), len(deviations)))
        return torch.from_numpy(draws) * torch.tensor(deviations, dtype=torch.float64)

    _, up, forward = target.unbind(-1)  # (n, 2)
    elevation = torch.asin((up / target.norm(dim=-1)).clamp(-1, 1))
    # The collar drops where the arm hangs (-17 degrees, as in fits of the SMPL body to motion capture), rises with it,
    # and comes forward where it reaches. Radians.
    lift = -0.30 + 0.45 * ((elevation + 0.9) / 2.2).clamp(0, 1)
    forth = -0.10 - 0.30 * forward.clamp(-0.2, 0.9)
    collar = torch.stack([lift, forth, torch.zeros_like(lift)], -1) + scatter(0.05, 0.05, 0.04)
    # The elbow points down, outward and back; the higher the hand, the more to the side.
    raised = elevation.clamp(0, 2)
    pole = torch.stack([0.45 + 0.5 * raised, 0.7 * raised - 0.9, torch.full_like(up, -0.55)], -1)
    pole = pole + scatter(0.30, 0.30, 0.35)
    turn = (10 + scatter(20.0).squeeze(-1)).deg2rad()
    wrist = scatter(14.0, 14.0, 8.0).deg2rad()
    hand = (scatter(4.0, 4.0, 4.0) - torch.tensor([12.0, 0.0, 0.0], dtype=torch.float64)).deg2rad()

    sign = torch.tensor(list(SIDES.values()), dtype=torch.float64)
    to_side = torch.stack([sign, torch.ones(2), torch.ones(2)], -1)  # of places
    to_side_about = torch.stack([sign, sign, torch.ones(2)], -1)  # of angles about z, y, x
    columns = {
        name: [JOINT_INDEX[f"{side}_{name}"] for side in SIDES]
        for name in ("collar", "shoulder", "elbow", "wrist", "hand")
    }
    for name, angles in (("collar", collar), ("wrist", wrist), ("hand", hand)):
        rotmat[:, columns[name]] = euler_to_rotmat(ARM_AXES, angles * to_side_about)
    to_elbow, to_wrist = offsets[columns["elbow"]], offsets[columns["wrist"]]  # (2, 3)
    length = (to_elbow.norm(dim=-1) + to_wrist.norm(dim=-1))[:, None]
    upper, lower = reach(to_elbow, to_wrist, target * to_side * length, pole * to_side, turn, sign)
    rotmat[:, columns["shoulder"]] = rotmat[:, columns["collar"]].mT @ upper
    rotmat[:, columns["elbow"]] = lower


def reach(
    to_elbow: Tensor, to_wrist: Tensor, target: Tensor, pole: Tensor, turn: Tensor, sign: Tensor
) -> tuple[Tensor, Tensor]:
    """Two-bone inverse kinematics: an elbow that is a hinge about its y axis brings the wrist to a target.

    Args:
        to_elbow: `(..., 3)`, metres, the elbow's rest offset from the shoulder.
        to_wrist: `(..., 3)`, metres, the wrist's from the elbow.
        target: `(..., 3)`, metres, the wrist's place relative to the shoulder, any frame. What is out of reach is
            reached for.
        pole: `(..., 3)`, where the elbow points from the line between shoulder and wrist, same frame.
        turn: `(...)`, radians, the forearm's turn about its own (x) axis.
        sign: `(...)`, 1 for a left arm, -1 for a right one: which way the elbow bends.

    Returns:
        The upper arm's rotations in that frame and the elbow's relative to the upper arm, `(..., 3, 3)` each.
    """
    roll = rotation_about("x", turn)
    to_wrist = (roll @ to_wrist[..., None]).squeeze(-1)
    to_elbow = to_elbow.expand_as(to_wrist)
    # In the hinge's plane: the angle between the bones by the law of cosines, less what it is at rest.
    flat_elbow, flat_wrist = (torch.hypot(bone[..., 0], bone[..., 2]) for bone in (to_elbow, to_wrist))
    elbow_turn, wrist_turn = (torch.atan2(bone[..., 0], bone[..., 2]) for bone in (to_elbow, to_wrist))
    at_rest = wrist_turn - elbow_turn
    along_hinge = to_elbow[..., 1] + to_wrist[..., 1]
    across = target.square().sum(-1) - along_hinge**2
    cosine = (across - flat_elbow**2 - flat_wrist**2) / (2 * flat_elbow * flat_wrist)
    narrowest, widest = (math.cos(math.radians(degrees)) for degrees in (_MAX_FLEXION_DEG, _MIN_FLEXION_DEG))
    flexion = cosine.clamp(narrowest, widest).acos()
    hinge = rotation_about("y", -sign * flexion - at_rest)

    wrist = to_elbow + (hinge @ to_wrist[..., None]).squeeze(-1)
    shoulder = _frame(target, pole) @ _frame(wrist, to_elbow).mT
    return shoulder, hinge @ roll


def _frame(first: Tensor, second: Tensor) -> Tensor:
    """Right-handed axes `(..., 3, 3)` as columns: along `first`, then towards `second` as far as it is across that."""
    x = first / first.norm(dim=-1, keepdim=True)
    y = second - (second * x).sum(-1, keepdim=True) * x
    y = y / y.norm(dim=-1, keepdim=True)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)
