"""A fit with a second look: where the first does not explain the image, the detector sees it in a mirror."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ljn.cloud.observation import MIRRORED, mirror_observations
from ljn.refinement.refiner import Refined, Refiner

DOUBT = 0.2
"""Misfit of a fit, from which on a second look is taken: some two bodies in a hundred seen without keypoints."""

Detect = Callable[[Mapping[str, Tensor]], Tensor]
"""Joints `(B, 24, 3)`, metres, camera frame, of a batch of observations."""
Regress = Callable[[Mapping[str, Tensor]], tuple[Tensor, Tensor]]
"""Pose `(B, 24, 3, 3)` and shape `(B, 10)` of a batch of observations whose `initial_joints` are the detector's."""


def second_look(detector: Any) -> Detect | None:
    """What sees mirrored images for `refine`; None without a detector, or where what it takes cannot be mirrored."""
    if detector is None or not set(detector.takes) <= MIRRORED:
        return None
    return lambda seen: detector(seen)  # not the module itself, which its keeper's state would have to hold


@torch.no_grad()
def refine(
    refiner: Refiner,
    seen: Mapping[str, Tensor],
    joints: Tensor,
    guess: tuple[Tensor, Tensor],
    detect: Detect | None,
    regress: Regress,
) -> tuple[Refined, Tensor]:
    """Fit the guesses of a batch, and other guesses of those frames whose fit leaves a doubt; the better fits.

    A detector that has mistaken the head for the feet, or front for back, often does not in the mirror image.

    Args:
        refiner: What fits.
        seen: The observations, for the detector, the regressor and the refiner.
        joints: `(B, 24, 3)`, what the detector found, metres, camera frame.
        guess: Pose `(B, 24, 3, 3)` and shape `(B, 10)` that the regressor made of it.
        detect: See `second_look`; None for one look alone.
        regress: The regressor.

    Returns:
        The fits, whose first residuals are those of `guess`, and the joints `(B, 24, 3)` they began with.
    """
    refined = refiner(seen, *guess, joints)
    doubtful = (refined.misfit > DOUBT).nonzero().squeeze(-1)
    if detect is None or not len(doubtful):
        return refined, joints
    some = {name: value[doubtful] for name, value in seen.items() if name in MIRRORED}
    found = mirror_observations({"initial_joints": detect(mirror_observations(some))})["initial_joints"]
    again = refiner(some, *regress(some | {"initial_joints": found}), found)
    is_better = again.misfit < refined.misfit[doubtful]
    better, taken = doubtful[is_better], [value[is_better] for value in again]
    values = [old.index_copy(0, better, new) for old, new in zip(refined, taken)]
    merged = Refined(*values)
    merged.residual_mm[:, 0], merged.unexplained[:, 0] = refined.residual_mm[:, 0], refined.unexplained[:, 0]
    return merged, joints.index_copy(0, better, found[is_better])
