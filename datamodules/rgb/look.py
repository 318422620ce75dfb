"""What a person looks like: materials with colours and patterns, where garments end, and the light."""

from dataclasses import dataclass, field

import numpy as np

MATERIALS = (
    "skin", "hair", "shirt", "trousers", "shoes", "gloves", "socks", "inner", "belt", "lips", "eyes", "beard",
)  # fmt: skip
MATERIAL = {name: number for number, name in enumerate(MATERIALS)}
PLAIN, STRIPES, CHECKS, CLOUDS, SPOTS, DOTS, PRINT = range(7)
"""Kinds of patterns."""
CUTS = (
    "hair_top", "hair_back", "hair_nape", "beard", "collar", "v_neck", "hem", "waist", "sleeve", "glove", "skirt",
    "trousers", "sock", "shoe", "opening", "belt",
)  # fmt: skip
CUT = {name: number for number, name in enumerate(CUTS)}
_NOWHERE = 9.0
_SKIN, _EYES = (0.80, 0.62, 0.52), (0.12, 0.09, 0.08)


@dataclass
class Look:
    """A person's look, filled in step by step; at first a figure without clothes and hair.

    Attributes:
        colours: `(M, 2, 3)` float32, linear RGB of each material: its ground, and its pattern.
        patterns: `(M, 9)` float32: the kind, its size (metres), its share, two directions in the rest pose (unit
            vectors).
        wear: `(M,)` float32: how much a material's lightness varies from place to place.
        gloss: `(M, 2)` float32: strength and exponent of its highlights.
        cuts: `(C,)` float32: where garments end, by the names in `CUTS`. Along arms and legs 0 is the shoulder or hip,
            1 the elbow or knee, 2 the wrist or ankle, 3 the end; along the trunk 0 is the pelvis, 1 the neck; along
            the head 0 is the chin, 1 the top, or from the front to the back.
        lights: `(L, 6)` float32: direction to the light in the camera frame (a unit vector), and colour.
        ambient: `(2, 3)` float32: colour of the light from above, and from below.
        shift: `(3,)` float32: where in the noise the person is, metres.
    """

    colours: np.ndarray = field(
        default_factory=lambda: np.tile(np.array(_SKIN, np.float32), (len(MATERIALS), 2, 1))
    )
    patterns: np.ndarray = field(default_factory=lambda: np.zeros((len(MATERIALS), 9), np.float32))
    wear: np.ndarray = field(default_factory=lambda: np.zeros(len(MATERIALS), np.float32))
    gloss: np.ndarray = field(
        default_factory=lambda: np.tile(np.array([0, 10], np.float32), (len(MATERIALS), 1))
    )
    cuts: np.ndarray = field(default_factory=lambda: _no_clothes())
    lights: np.ndarray = field(
        default_factory=lambda: np.array([[-0.25, -0.35, -0.9, 0.7, 0.7, 0.7]], np.float32)
    )
    ambient: np.ndarray = field(default_factory=lambda: np.full((2, 3), 0.3, np.float32))
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3, np.float32))

    def paint(self, material: str, colour: np.ndarray, pattern: np.ndarray | None = None) -> None:
        """Give a material a colour `(3,)`, linear RGB, and its pattern another; None: the same."""
        self.colours[MATERIAL[material]] = np.clip(
            [colour, colour if pattern is None else pattern], 0.01, 0.95
        )

    def cut(self, **places: float) -> None:
        """Say where garments end, by the names in `CUTS`."""
        for name, place in places.items():
            self.cuts[CUT[name]] = place


def _no_clothes() -> np.ndarray:
    cuts = np.full(len(CUTS), _NOWHERE, np.float32)
    for name in ("collar", "v_neck", "waist", "sleeve", "skirt", "trousers", "opening", "beard"):
        cuts[CUT[name]] = -_NOWHERE
    return cuts
