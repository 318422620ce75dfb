"""Shapes and genders for poses that come without."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ljn.body import GENDERS
from ljn.body.files import NUM_BETAS


class Shapes(NamedTuple):
    """The shapes of some bodies."""

    gender: np.ndarray  # `(n,)` int64, codes of `GENDERS`
    betas: np.ndarray  # `(n, 10)` float64


def draw_shapes(rng: np.random.Generator, n: int, genders: Sequence[str], max_beta: float) -> Shapes:
    """Genders, each equally often, and standard normal coefficients, drawn again where they exceed `max_beta`."""
    gender = rng.choice([GENDERS[name] for name in genders], n)
    betas = rng.standard_normal((n, NUM_BETAS))
    while (outside := np.abs(betas) > max_beta).any():
        betas[outside] = rng.standard_normal(np.count_nonzero(outside))
    return Shapes(gender, betas)


def check_shapes(genders: Sequence[str], max_beta: float) -> None:
    """Raise a `ValueError` unless shapes can be drawn so."""
    if not max_beta > 0:
        raise ValueError(f"max_beta: expected more than 0, got {max_beta}")
    if not genders or set(genders) - set(GENDERS):
        raise ValueError(f"genders: expected some of {', '.join(GENDERS)}, got {list(genders)}")
