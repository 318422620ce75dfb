"""The pool of poses as a mixture: what is drawn how often, held within limits, and drawn again where it fails."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.clearance import Clearance
from datamodules.sources.embedded.families import FAMILIES
from datamodules.sources.embedded.joint_limits import within_limits
from datamodules.sources.embedded.procedural import draw_poses
from datamodules.sources.embedded.recombination import Donors, Made, jittered, swapped_poses, whole_poses
from ljn.body import BodyModel
from ljn.body.kinematics import without_heading
from ljn.body.skeleton import NUM_JOINTS, ROOT

KINDS = ("whole", "swapped", "mixed", "procedural")
"""How a pose is made: a frame of a clip; parts of frames; parts of frames and of procedural poses; a family."""

_PROCEDURAL = "proc/"
_MAX_ROUNDS = 200


@dataclass(frozen=True)
class MixtureSettings:
    """What a mixture is made of.

    Attributes:
        shares: How often each of `KINDS` is drawn, relative to each other; one left out never is.
        families: How often each procedural family is drawn, likewise; keys of `FAMILIES`.
        blend_share: Share of the trunks and of the arms in recombined poses that lie between two donors' ones.
        apart_share: Share of the recombined poses whose two arms have a donor each.
        jitter_deg: Standard deviation of the jitter of whole and recombined poses about each axis, degrees.
        max_penetration_m: How far body parts may reach into each other, metres.
    """

    shares: Mapping[str, float]
    families: Mapping[str, float]
    blend_share: float
    apart_share: float
    jitter_deg: float
    max_penetration_m: float

    def __post_init__(self) -> None:
        for name, shares, known in (("shares", self.shares, KINDS), ("families", self.families, FAMILIES)):
            if set(shares) - set(known) or min(shares.values(), default=0) < 0 or sum(shares.values()) <= 0:
                raise ValueError(
                    f"{name}: expected numbers of 0 or more, not all 0, for some of {', '.join(known)}; got "
                    f"{dict(shares)}"
                )
        for name in ("blend_share", "apart_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a share from 0 to 1, got {getattr(self, name)}")
        for name in ("jitter_deg", "max_penetration_m"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a number of 0 or more, got {getattr(self, name)}")


class PoseMixture:
    """Draws poses of a mixture of frames of clips and families, clear on a body and the reference skeleton."""

    def __init__(self, settings: MixtureSettings, donors: Donors, body: BodyModel) -> None:
        self.settings = settings
        self.donors = donors
        self._clearance = Clearance(body)
        families, kinds = _normalised(settings.families, FAMILIES), _normalised(settings.shares, KINDS)
        share = kinds.pop("procedural", 0.0)
        self._families = {f"{_PROCEDURAL}{name}": of_family for name, of_family in families.items()}
        self.labels = kinds | {
            label: share * of_family for label, of_family in self._families.items() if share
        }

    def draw(self, rng: np.random.Generator, n: int) -> Made:
        """`n` poses in their shares: what is drawn for a place is drawn again, of the same kind, until it is clear.

        Raises:
            ValueError: Some kind yields no clear pose.
        """
        labels = rng.choice(list(self.labels), n, p=list(self.labels.values()))
        result = self.propose(rng, labels)
        open_rows = np.flatnonzero(~self.is_clear(result.rotmat))
        for _ in range(_MAX_ROUNDS):
            if not len(open_rows):
                break
            again = self.propose(rng, labels[open_rows])
            _put(result, open_rows, again)
            open_rows = open_rows[~self.is_clear(again.rotmat)]
        if len(open_rows):
            names = ", ".join(sorted(set(result.name[open_rows].tolist()))[:5])
            raise ValueError(
                f"max_penetration_m: in {_MAX_ROUNDS} tries {len(open_rows)} of {n} poses still reached into "
                f"themselves by more than {self.settings.max_penetration_m} m ({names}); allow more, or leave such "
                "clips out"
            )
        return result

    def is_clear(self, rotmat: Tensor) -> np.ndarray:
        """Which poses `(n, 24, 3, 3)` do not reach into themselves by more than the limit, `(n,)` bool."""
        return (self.depth(rotmat) <= self.settings.max_penetration_m).numpy()

    def depth(self, rotmat: Tensor) -> Tensor:
        """The deepest penetration of poses `(n, 24, 3, 3)` on the body or the reference skeleton: `(n,)`, metres."""
        return self._clearance.depth(rotmat)

    def propose(self, rng: np.random.Generator, labels: np.ndarray) -> Made:
        """Poses of the kinds or families that `labels` `(n,)` name, within joint limits, not yet tested."""
        n = len(labels)
        result = Made(
            torch.empty(n, NUM_JOINTS, 3, 3, dtype=torch.float64), np.empty(n, object), np.empty(n, np.int64)
        )
        is_procedural = np.char.startswith(labels, _PROCEDURAL)
        for kind in KINDS:
            rows = np.flatnonzero(is_procedural if kind == "procedural" else labels == kind)
            if len(rows) and kind == "procedural":
                _put(result, rows, self._draw_families(rng, labels[rows]))
            elif len(rows):
                _put(result, rows, self._make(rng, kind, len(rows)))
        return result._replace(rotmat=within_limits(result.rotmat))

    def _make(self, rng: np.random.Generator, kind: str, n: int) -> Made:
        """Poses made of donors."""
        settings = self.settings
        if kind == "whole":
            made = whole_poses(self.donors, rng, n)
        else:
            tables: tuple[Donors, ...] = (self.donors,)
            if kind == "mixed":
                labels = rng.choice(list(self._families), n, p=list(self._families.values()))
                tables += (Donors(*self._draw_families(rng, labels), weight=np.full(n, 1 / n)),)
            made = swapped_poses(tables, settings.blend_share, settings.apart_share, rng, n)
        return made._replace(rotmat=jittered(made.rotmat, settings.jitter_deg, rng))

    def _draw_families(self, rng: np.random.Generator, labels: np.ndarray) -> Made:
        """Procedural poses of the families that `labels` `(n,)` name."""
        names = np.array([label.removeprefix(_PROCEDURAL) for label in labels.tolist()])
        rotmat = draw_poses(rng, names, self._clearance.offsets)
        rotmat[:, ROOT] = without_heading(rotmat[:, ROOT])
        return Made(rotmat, labels, np.full(len(labels), -1))


def _put(poses: Made, rows: np.ndarray, others: Made) -> None:
    """Write `others` into `rows` of `poses`."""
    poses.rotmat[torch.from_numpy(rows)] = others.rotmat
    poses.name[rows] = others.name
    poses.frame[rows] = others.frame


def _normalised(shares: Mapping[str, float], known: Iterable[str]) -> dict[str, float]:
    """The shares that are not zero, normalised to a sum of 1, in the order of `known`."""
    total = sum(shares.values())
    return {name: shares[name] / total for name in known if shares.get(name, 0) > 0}
