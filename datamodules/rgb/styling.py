"""Steps of what a person looks like, and of the light."""

import colorsys
from dataclasses import dataclass

import numpy as np

from datamodules.rgb.chain import ColourStep
from datamodules.rgb.look import CHECKS, CLOUDS, DOTS, MATERIAL, PRINT, SPOTS, STRIPES, Look

_DISPLAY_GAMMA = 2  # see `kernels.composed`
_SKINS = (
    (0.96, 0.80, 0.70), (0.90, 0.70, 0.57), (0.78, 0.57, 0.43), (0.60, 0.41, 0.30), (0.38, 0.25, 0.18),
    (0.24, 0.16, 0.12),
)  # fmt: skip
_HAIRS = (
    (0.06, 0.05, 0.05), (0.16, 0.10, 0.07), (0.33, 0.21, 0.13), (0.55, 0.38, 0.22), (0.80, 0.66, 0.42),
    (0.62, 0.60, 0.58), (0.45, 0.17, 0.08),
)  # fmt: skip
_CLOTHES = ("shirt", "trousers", "inner", "shoes", "gloves", "socks", "belt")


def _linear(colour: np.ndarray) -> np.ndarray:
    return np.maximum(np.minimum(colour, 0.97), 0.03) ** _DISPLAY_GAMMA


def _from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """Linear RGB `(3,)`."""
    return _linear(np.array(colorsys.hsv_to_rgb(hue % 1, min(saturation, 1), min(value, 1))))


def _between(colours: tuple[tuple[float, ...], ...], place: float) -> np.ndarray:
    """A colour on the way along several; `place` in 0-1."""
    position = place * (len(colours) - 1)
    index = min(int(position), len(colours) - 2)
    low, high = np.array(colours[index]), np.array(colours[index + 1])
    return low + (position - index) * (high - low)


@dataclass(frozen=True, kw_only=True)
class Skin(ColourStep):
    """The skin's tone, from light to dark; lips and eyes.

    Attributes:
        spread: Standard deviation of each channel around the tones, as a share.
    """

    spread: float = 0.06

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        place = 0.3 + strength * (rng.random() - 0.3)
        tone = _between(_SKINS, float(np.clip(place, 0, 1))) * (
            1 + strength * self.spread * rng.standard_normal(3)
        )
        for name in ("skin", "beard"):
            look.paint(name, _linear(tone))
        look.paint("lips", _linear(tone * (0.9, 0.68, 0.68)))
        look.paint("eyes", _linear(np.array([0.13, 0.10, 0.09]) * rng.uniform(0.5, 2.0)))
        look.gloss[MATERIAL["skin"]] = rng.uniform(0, 0.08) * strength, rng.uniform(8, 30)
        look.wear[MATERIAL["skin"]] = 0.12 * strength


@dataclass(frozen=True, kw_only=True)
class Hair(ColourStep):
    """Hair on the head, short or long, of many colours, or a hat; beards and brows.

    Attributes:
        bald: Share of the heads without hair.
        long: Share with long hair.
        beard: Share with a beard.
        dyed: Share whose colour is any, as a hat's.
    """

    bald: float = 0.08
    long: float = 0.35
    beard: float = 0.25
    dyed: float = 0.15

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        bald, is_long, beard, dyed, place, *cuts = rng.random(9)
        colour = _linear(_between(_HAIRS, place) * rng.uniform(0.6, 1.3))
        look.paint("beard", 0.35 * look.colours[MATERIAL["skin"], 0] + 0.65 * colour)
        if dyed < self.dyed * strength:
            hue, saturation, value = rng.random(3)
            colour = _from_hsv(hue, saturation, 0.15 + 0.8 * value)
        look.paint("hair", colour)
        look.wear[MATERIAL["hair"]] = 0.5
        look.gloss[MATERIAL["hair"]] = rng.uniform(0, 0.15), rng.uniform(5, 20)
        if beard < self.beard * strength:
            look.cut(beard=0.15 + 0.25 * cuts[0])
        if bald >= self.bald * strength:
            nape = -1.2 + 1.3 * cuts[3] if is_long < self.long else 0.05 + 0.3 * cuts[3]
            look.cut(hair_top=0.72 + 0.16 * cuts[1], hair_back=0.42 + 0.2 * cuts[2], hair_nape=nape)


@dataclass(frozen=True, kw_only=True)
class Garments(ColourStep):
    """Shirts, dresses, jackets, trousers, shoes, socks, gloves, belts: which, how long, and of what colour.

    Attributes:
        sleeves: Shares of no, short and long sleeves, relative to each other.
        shorts: Share of short trousers.
        dresses: Share of dresses, skirts and long shirts.
        jacket: Share of open jackets.
        belly: Share of short tops over bare skin.
        gloves: Share of gloves.
        barefoot: Share of bare feet.
        alike: Share whose clothes have one colour.
        bare: Share without a shirt.
        skin_coloured: Share whose shirt or trousers have nearly the skin's colour.
    """

    sleeves: tuple[float, ...] = (0.15, 0.45, 0.4)
    shorts: float = 0.3
    dresses: float = 0.12
    jacket: float = 0.15
    belly: float = 0.06
    gloves: float = 0.08
    barefoot: float = 0.12
    alike: float = 0.12
    bare: float = 0.04
    skin_coloured: float = 0.04

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        for name in _CLOTHES:
            look.paint(name, self._colour(rng, strength))
            look.wear[MATERIAL[name]] = rng.uniform(0.05, 0.35)
        (dress, jacket, belly, gloves, barefoot, alike, bare, near), which = rng.random(8), rng.random(2)
        cuts = rng.random(12)
        if alike < self.alike:
            for name in ("shirt", "trousers"):
                look.paint(name, look.colours[MATERIAL["shirt"], 0])
        if near < self.skin_coloured:
            look.paint("shirt" if cuts[11] < 0.5 else "trousers", 0.9 * look.colours[MATERIAL["skin"], 0])
        self._cut_shirt(look, which[0], cuts, bare < self.bare)
        hem = -0.25 + 0.3 * cuts[4]
        look.cut(hem=hem, waist=hem + 0.02, belt=0.02 + 0.02 * cuts[5] if cuts[6] < 0.3 else 9)
        look.cut(trousers=0.3 + 0.8 * cuts[7] if which[1] < self.shorts else 1.75 + 0.4 * cuts[7])
        if barefoot >= self.barefoot:
            look.cut(shoe=2.0 + 0.25 * cuts[8] - (0.7 * cuts[9] if cuts[10] < 0.15 else 0))
            look.cut(sock=2.0 - 0.5 * cuts[9] if cuts[10] > 0.5 else 9)
        if belly < self.belly:
            look.cut(hem=0.1 + 0.3 * cuts[4], waist=-0.15 + 0.15 * cuts[5], belt=9)
        if jacket < self.jacket:
            look.cut(opening=0.02 + 0.08 * cuts[9])
        if gloves < self.gloves:
            look.cut(glove=1.85 + 0.2 * cuts[8])
        if dress < self.dresses:
            look.cut(skirt=0.2 + 1.2 * cuts[7] ** 2, hem=-9, belt=9)
            if cuts[10] < 0.6:
                look.cut(trousers=-9)
        look.gloss[MATERIAL["shoes"]] = rng.uniform(0, 0.3), rng.uniform(5, 40)
        for name in ("shirt", "trousers", "inner"):
            look.gloss[MATERIAL[name]] = 0.15 * rng.random() ** 3, rng.uniform(4, 20)

    def _cut_shirt(self, look: Look, which: float, cuts: np.ndarray, is_bare: bool) -> None:
        if is_bare:
            look.cut(hem=9)
            return
        sleeves = np.cumsum(self.sleeves) / sum(self.sleeves)
        if which < sleeves[0]:
            sleeve = -9.0 if cuts[0] < 0.5 else 0.15 * cuts[1]
        elif which < sleeves[1]:
            sleeve = 0.3 + 0.8 * cuts[1]
        else:
            sleeve = 1.6 + 0.45 * cuts[1]
        look.cut(
            sleeve=sleeve, collar=0.85 + 0.3 * cuts[2], v_neck=0.55 + 0.3 * cuts[3] if cuts[0] < 0.3 else 9
        )

    def _colour(self, rng: np.random.Generator, strength: float) -> np.ndarray:
        """Linear RGB: any, but often grey, white, black or dark blue."""
        kind, hue, saturation, value = rng.random(4)
        if kind < 0.15:
            hue, saturation, value = hue, 0.1 * saturation, 0.75 + 0.25 * value
        elif kind < 0.35:
            hue, saturation, value = hue, 0.25 * saturation, 0.03 + 0.2 * value
        elif kind < 0.5:
            hue, saturation, value = 0.57 + 0.1 * hue, 0.3 + 0.5 * saturation, 0.15 + 0.5 * value
        elif kind < 0.65:
            saturation, value = 0.1 * saturation, 0.2 + 0.6 * value
        else:
            value = 0.15 + 0.85 * value
        return _linear(np.array([0.5, 0.5, 0.5])) * max(0.0, 1 - strength) + min(1.0, strength) * _from_hsv(
            hue, saturation, value
        )


@dataclass(frozen=True, kw_only=True)
class Patterns(ColourStep):
    """Stripes, checks, clouds, spots, dots and prints on clothes, in the rest pose, so that they move with the body.

    Attributes:
        each: Share of the garments that have one.
        size_m: Range of their size, metres.
    """

    each: float = 0.45
    size_m: tuple[float, float] = (0.015, 0.15)

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        look.shift[:] = rng.uniform(0, 9, 3)
        for name in ("shirt", "trousers", "inner", "shoes", "socks", "hair"):
            draws, hsv, directions = rng.random(4), rng.random(3), rng.standard_normal((2, 3))
            if draws[0] >= self.each * (0.3 if name == "hair" else 1):
                continue
            kinds = (STRIPES, STRIPES, CHECKS, CLOUDS, SPOTS, DOTS, PRINT if name == "shirt" else CLOUDS)
            if draws[3] < 0.7:  # along the body's axes
                directions = np.eye(3)[[1, 0] if draws[3] < 0.45 else [0, 1]]
            directions[1] -= directions[0] * (directions[0] @ directions[1]) / (directions[0] @ directions[0])
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            size = self.size_m[0] * (self.size_m[1] / self.size_m[0]) ** rng.random()
            m = MATERIAL[name]
            look.patterns[m] = (
                kinds[int(draws[1] * len(kinds))],
                size,
                0.25 + 0.5 * draws[2],
                *directions.ravel(),
            )
            ground = look.colours[m, 0]
            look.colours[m, 1] = ground + min(1.0, strength) * (_from_hsv(*hsv) - ground)


@dataclass(frozen=True, kw_only=True)
class Lights(ColourStep):
    """One to three lights and what comes from all around, from any side, more often from above and the front.

    Attributes:
        most: Greatest number of lights.
        ambient: Range of the light from all around.
        key: Range of the strongest light.
        colour: Standard deviation of each channel of a light's colour, as a share.
    """

    most: float = 3
    ambient: tuple[float, float] = (0.2, 0.8)
    key: tuple[float, float] = (0.3, 1.1)
    colour: float = 0.12

    def style(self, look: Look, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        number = int(rng.integers(1, int(self.most) + 1))
        directions = rng.standard_normal((number, 3)) * (1, 0.8, 1) + (0, -0.5, -0.6)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        power = rng.uniform(*self.key) * np.array([1.0, 0.6, 0.4, *([0.3] * number)])[:number]
        tint = 1 + strength * self.colour * rng.standard_normal((number + 2, 3))
        look.lights = np.concatenate([directions, power[:, None] * np.maximum(tint[:number], 0.2)], 1).astype(
            np.float32
        )
        around = rng.uniform(*self.ambient)
        look.ambient = (
            around * np.array([[1.0], [rng.uniform(0.4, 1.0)]]) * np.maximum(tint[number:], 0.2)
        ).astype(np.float32)
