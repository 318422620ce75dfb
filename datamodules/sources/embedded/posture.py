"""What a posture consists of, and the random numbers that families draw it with."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from datamodules.sources.embedded.arms import GOALS


class Draw:
    """Random numbers for a family's `n` poses."""

    def __init__(self, rng: np.random.Generator, n: int) -> None:
        self.rng = rng
        self.n = n

    def normal(self, deviation: float, *shape: int) -> np.ndarray:
        """Normal values of mean zero, `(n, *shape)`."""
        return deviation * self.rng.standard_normal((self.n, *shape))

    def half_normal(self, deviation: float, *shape: int) -> np.ndarray:
        """Absolute values of normal ones, `(n, *shape)`."""
        return np.abs(self.normal(deviation, *shape))

    def uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        """Uniform values, `(n, *shape)`."""
        return self.rng.uniform(low, high, (self.n, *shape))

    def chance(self, share: float) -> np.ndarray:
        """True with a probability of `share`, `(n,)`."""
        return self.rng.random(self.n) < share

    def sides(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Two legs' values `(n, 2)`: `one` on a random side and `other` on the opposite one."""
        is_left = self.chance(0.5)[:, None]
        return np.where(is_left, np.stack([one, other], 1), np.stack([other, one], 1))

    def goals(self, shares: Mapping[str, float]) -> np.ndarray:
        """Goals of both hands, `(n, 2)` indices into `GOALS`; a third of the poses uses both hands alike."""
        weights = np.array([shares.get(name, 0.0) for name in GOALS])
        goals = self.rng.choice(len(GOALS), (self.n, 2), p=weights / weights.sum())
        goals[:, 1] = np.where(self.chance(0.35), goals[:, 0], goals[:, 1])
        return goals

    def positions(self, shares: Mapping[tuple[str, str], float]) -> np.ndarray:
        """Goals of both hands, `(n, 2)` indices into `GOALS`, drawn as pairs of the left and the right one."""
        names, weights = list(GOALS), np.array(list(shares.values()))
        pairs = np.array([[names.index(name) for name in pair] for pair in shares])
        return pairs[self.rng.choice(len(pairs), self.n, p=weights / weights.sum())]


@dataclass
class Posture:
    """What a family decides: `n` poses, degrees, left before right."""

    thigh: np.ndarray  # `(n, 2)`, forward of straight down; the hip flexes by this and the pelvis' pitch
    knee: np.ndarray  # `(n, 2)`, flexion
    goals: np.ndarray  # `(n, 2)`, indices into `GOALS`
    foot: np.ndarray | float = 0.0  # `(n, 2)`, how far toes are raised above level (without spread, turnout)
    spread: np.ndarray | float = 0.0  # `(n, 2)`, how far the legs are out of the vertical, to their sides
    turnout: np.ndarray | float = 0.0  # `(n, 2)`, hips' outward rotation
    pitch: np.ndarray | float = 0.0  # `(n,)`, of the pelvis, forward
    roll: np.ndarray | float = 0.0  # `(n,)`, of the pelvis, to the right
    turn: np.ndarray | float = 0.0  # `(n,)`, of the pelvis about the trunk's axis, to the left
    bend: np.ndarray | float = 0.0  # `(n,)`, of the spine, forward
    twist: np.ndarray | float = 0.0  # `(n,)`, of the spine, to the left
    lean: np.ndarray | float = 0.0  # `(n,)`, of the spine, to the right
    nod: np.ndarray | float = 0.0  # `(n,)`, of head and neck, forward
    swing: np.ndarray | float = 0.0  # `(n,)`, of the left arm, forward, arm lengths
    drop: np.ndarray | float = 0.0  # `(n,)`, how far both hands' targets are turned downwards
