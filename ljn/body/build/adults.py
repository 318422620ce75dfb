"""Adults as MakeHuman's attributes, sampled so that stature and body mass index look like a population's."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Adults = dict[str, Array]
"""n adults: `gender` (0 male, 1 female), `age` (young to old), `muscle`, `weight`, `height`, `proportions`,
`cupsize` and `firmness`, each `(n,)` in 0..1, and `ethnicity` `(n, 3)`, rows summing to 1."""

ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "gender": ("male", "female"),
    "age": ("young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "maxheight"),
    "proportions": ("idealproportions", "uncommonproportions"),
    "ethnicity": ("african", "asian", "caucasian"),
    "cupsize": ("mincup", "averagecup", "maxcup"),
    "firmness": ("minfirmness", "averagefirmness", "maxfirmness"),
}
"""The values for which MakeHuman has targets, spread evenly over 0..1; each is named only once."""


def blend_weights(keys: list[tuple[str, ...]], adults: Adults) -> Array:
    """How much of each target an adult gets, `(n, T)`: the product of its attributes' interpolation weights.

    Targets are named by the attribute values that they belong to; the weights of a family that has a target for every
    combination of values sum to 1.
    """
    shares: dict[str, Array] = {}
    for attribute, names in ATTRIBUTES.items():
        value = adults[attribute]
        if value.ndim == 2:
            shares |= dict(zip(names, value.T))
            continue
        place = value * (len(names) - 1)
        shares |= {name: np.clip(1 - np.abs(place - k), 0, 1) for k, name in enumerate(names)}
    return np.stack([np.prod([shares[name] for name in key], axis=0) for key in keys], axis=-1)


def average_adult() -> Adults:
    """One adult in the middle of every attribute, of a middle stature."""
    adult = {name: np.full(1, 0.5) for name in ATTRIBUTES}
    return adult | {"height": np.full(1, 0.37), "ethnicity": np.full((1, 3), 1 / 3)}


def sample_adults(rng: np.random.Generator, count: int, gender: str) -> Adults:
    """Random adults of a gender; `neutral` is every mixture of the two with equal chance.

    Heights are set to a stature of about 1.74 +- 0.08 m (men) and 1.63 +- 0.08 m (women), weight and muscle to a
    BMI of about 23.5 +- 4: MakeHuman's attributes themselves say nothing about how frequent they are. Men and women
    alone would give two heaps for `neutral`, between and beyond which the components of a PCA make up bodies that
    nobody has, such as caved-in chests.
    """
    if gender == "neutral":
        sex = rng.uniform(0, 1, count)
    else:
        sex = np.clip(np.abs(rng.normal(0, 0.06, count)), 0, 1)
        sex = sex if gender == "male" else 1 - sex
    is_female = rng.uniform(0, 1, count) < sex if gender == "neutral" else np.full(count, gender == "female")

    def either(male: tuple[float, float], female: tuple[float, float]) -> Array:
        return np.where(is_female, rng.beta(*female, count), rng.beta(*male, count))

    height = np.where(is_female, rng.normal(0.375, 0.060, count), rng.normal(0.368, 0.064, count))
    return {
        "gender": sex,
        "height": np.clip(height, 0.12, 0.62),
        "age": rng.beta(1.2, 2.0, count),
        "weight": either(male=(1.1, 0.8), female=(1.5, 0.55)),
        "muscle": either(male=(1.5, 1.7), female=(1.0, 2.0)),
        "proportions": rng.beta(2, 2, count),
        "cupsize": rng.beta(3, 3, count),
        "firmness": rng.beta(3, 3, count),
        "ethnicity": rng.dirichlet([0.6] * 3, count),
    }
