"""Families of everyday and athletic postures, drawn from how joints work together.

A family sets hips, knees, ankles, trunk and pelvis together, in the terms of clinical biomechanics and in degrees;
arms go where hands have something to do (`arms`). The numbers are round figures from textbooks on gait and movement
(Winter, *Biomechanics and Motor Control of Human Movement*; Perry, *Gait Analysis*) and from trying the postures.
"""

from collections.abc import Callable

import numpy as np

from datamodules.sources.embedded.posture import Draw, Posture

_FREE_ARMS = {"hang": 0.30, "front": 0.25, "overhead": 0.13, "wide": 0.14, "face": 0.09, "hips": 0.09}
_WALKING_ARMS = {"hang": 0.80, "front": 0.10, "face": 0.05, "wide": 0.05}
_RUNNING_ARMS = {"run": 0.80, "hang": 0.10, "front": 0.10}
_BALANCING_ARMS = {"wide": 0.40, "overhead": 0.20, "front": 0.20, "hang": 0.10, "hips": 0.10}
_SUPINE_ARMS = {"beside": 0.35, "flat": 0.25, "front": 0.20, "face": 0.20}
_PRONE_ARMS = {"beside": 0.40, "flat": 0.60}
_ASIDE_ARMS = {"front": 0.40, "face": 0.30, "beside": 0.30}

_CLIMBING_ARMS = {"overhead": 0.55, "front": 0.20, "high": 0.25}
_DANCE_POSITIONS = {
    ("low", "low"): 0.10, ("round", "round"): 0.12, ("side", "side"): 0.28, ("high", "high"): 0.16,
    ("side", "high"): 0.10, ("high", "side"): 0.10, ("side", "round"): 0.07, ("round", "side"): 0.07,
}  # fmt: skip
"""Ballet's positions of the arms, left and right."""


def stand(draw: Draw) -> Posture:
    """On both feet, one knee more bent than the other; three in ten stoop, half from the hips."""
    knee = 3 + draw.half_normal(9, 2)
    stoop = draw.chance(0.3) * draw.uniform(10, 100)
    return Posture(
        thigh=0.5 * knee + draw.normal(4, 2),
        knee=knee,
        goals=draw.goals(_FREE_ARMS),
        spread=2 + draw.half_normal(7, 2),
        turnout=5 + draw.normal(9, 2),
        pitch=draw.normal(5) + 0.5 * stoop,
        roll=draw.normal(3),
        bend=draw.half_normal(9) + 0.5 * stoop,
        twist=draw.normal(16),
        lean=draw.normal(8),
    )


def _stride(draw: Draw, stretch: float, knee_lift: float) -> dict[str, np.ndarray]:
    """A step: Fourier series of normal gait for thighs and knees; arms and trunk turn against the legs."""
    phase = draw.uniform(0, 2 * np.pi)
    legs = phase[:, None] + np.array([0.0, np.pi])
    amplitude = draw.uniform(0.6, 1.3)[:, None]
    thigh = 8 + stretch * amplitude * (24 * np.cos(legs) - 2 * np.cos(2 * legs))
    knee = 24 - 8 * np.cos(legs) - 24 * np.sin(legs) - 16 * np.cos(2 * legs) + 8 * np.sin(2 * legs)
    thigh = thigh + draw.normal(3, 2)
    knee = knee_lift * knee.clip(0) * amplitude + draw.half_normal(4, 2)
    return {
        "thigh": thigh,
        "knee": knee,
        # A foot is level while that takes no more than 20 degrees of the ankle, a little up as the heel strikes.
        "foot": np.minimum(8 * np.cos(legs), thigh - knee + 20) + draw.normal(6, 2),
        "twist": 8 * stretch * np.cos(phase) + draw.normal(8),
        "swing": -0.30 * np.cos(phase),
    }


def _swapped(is_swapped: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
    """Values of two legs `(n, 2)`, those of the left and the right one swapped where `(n,)` says so."""
    return [np.where(is_swapped[:, None], legs[:, ::-1], legs) for legs in values]


def walk(draw: Draw) -> Posture:
    """A step at any speed."""
    return Posture(
        **_stride(draw, stretch=1.0, knee_lift=1.0),
        goals=draw.goals(_WALKING_ARMS),
        spread=1 + draw.normal(3, 2),
        turnout=4 + draw.normal(6, 2),
        pitch=4 + draw.normal(4),
        roll=draw.normal(3),
        bend=2 + draw.half_normal(6),
        lean=draw.normal(4),
    )


def run(draw: Draw) -> Posture:
    """A running step: longer, knees higher, the trunk forward, elbows bent."""
    stride = _stride(draw, stretch=1.5, knee_lift=1.7)
    stride["thigh"] += 6
    stride["foot"] -= 10
    return Posture(
        **stride,
        goals=draw.goals(_RUNNING_ARMS),
        spread=1 + draw.normal(3, 2),
        turnout=3 + draw.normal(6, 2),
        pitch=8 + draw.normal(6),
        bend=8 + draw.half_normal(6),
        lean=draw.normal(4),
    )


def squat(draw: Draw) -> Posture:
    """From a slight crouch to a deep squat: knees and hips bend together, the shins lean, the trunk balances."""
    depth = draw.uniform(0, 1)
    knee = 20 + 120 * depth[:, None] + draw.normal(8, 2)
    shin = 8 + 24 * depth[:, None] + draw.normal(4, 2)
    return Posture(
        thigh=knee - shin,
        knee=knee,
        goals=draw.goals(_FREE_ARMS),
        foot=(draw.chance(0.3) * draw.uniform(-30, 0))[:, None],
        spread=5 + 10 * depth[:, None] + draw.half_normal(10, 2),
        turnout=6 + 10 * depth[:, None] + draw.normal(9, 2),
        pitch=(8 + 24 * depth) * draw.uniform(0.2, 1.2),
        roll=draw.normal(4),
        bend=draw.half_normal(10) + 15 * depth,
        twist=draw.normal(14),
        lean=draw.normal(8),
    )


def lunge(draw: Draw) -> Posture:
    """A long step, one leg before the other or, one in four, to the side."""
    front, is_sideways = draw.uniform(15, 90), draw.chance(0.25)
    knee = np.stack([(front + draw.normal(18)).clip(0), draw.uniform(3, 70)], 1)
    thigh = np.stack([front, np.where(is_sideways, draw.uniform(0, 30), -draw.uniform(0, 40))], 1)
    knee[:, 1] *= np.where(is_sideways, 0.3, 1.0)
    spread = 3 + draw.half_normal(10, 2)
    spread[:, 1] += is_sideways * draw.uniform(10, 40)
    thigh, knee, spread = _swapped(draw.chance(0.5), thigh, knee, spread)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.goals(_FREE_ARMS),
        foot=np.where(thigh < 0, -30.0, 0.0) + draw.normal(8, 2),
        spread=spread,
        turnout=6 + draw.normal(12, 2),
        pitch=6 + draw.normal(7) + draw.chance(0.3) * draw.uniform(0, 40),
        roll=draw.normal(5),
        bend=draw.half_normal(12),
        twist=draw.normal(18),
        lean=draw.normal(10),
    )


def sit(draw: Draw) -> Posture:
    """On a chair; or, one in five each, on the floor with the legs out, or cross-legged."""
    way = draw.uniform(0, 1)
    is_long, is_crossed = (way < 0.2)[:, None], ((way >= 0.2) & (way < 0.4))[:, None]
    knee = draw.uniform(40, 115)[:, None] + draw.normal(14, 2)
    knee = np.where(is_long, draw.half_normal(18, 2), np.where(is_crossed, draw.uniform(100, 130, 2), knee))
    thigh = np.where(is_long | is_crossed, 88 + draw.normal(5, 2), 82 + draw.normal(9, 2))
    return Posture(
        thigh=thigh + np.where(is_long, 0.5 * knee, 0.0),
        knee=knee,
        goals=draw.goals(_FREE_ARMS),
        foot=np.where(is_long, 80.0, 0.0) + draw.normal(10, 2) - is_crossed * 20,
        spread=np.where(is_crossed, 46.0, 5.0) + draw.normal(9, 2),
        turnout=np.where(is_crossed, 56.0, 4.0) + draw.normal(9, 2),
        pitch=-6 + draw.normal(10),
        roll=draw.normal(3),
        bend=draw.half_normal(18),
        twist=draw.normal(18),
        lean=draw.normal(9),
    )


def kick(draw: Draw) -> Posture:
    """On one leg, the other raised to the front, behind or to the side, bent or straight; the trunk balances it."""
    way = draw.uniform(0, 1)
    is_behind, is_sideways = way < 0.35, way > 0.75
    raised = np.where(is_behind, -draw.uniform(0, 70), draw.uniform(10, 115))
    raised = np.where(is_sideways, draw.uniform(-15, 40), raised)
    bent = draw.uniform(0, 125) * draw.chance(0.65) + draw.half_normal(8)
    # Hips extend little: a leg that goes far back takes the pelvis with it.
    pitch = draw.normal(6) + np.where(is_behind, -0.7 * raised, 0.0)
    standing = draw.half_normal(9) + 4
    thigh, knee = np.stack([0.5 * standing, raised], 1), np.stack([standing, bent], 1)
    spread = 3 + draw.half_normal(9, 2)
    spread[:, 1] += is_sideways * draw.uniform(15, 55) + draw.half_normal(12)
    # One foot is level, the other in line with its shin, more or less.
    foot = np.stack([np.zeros(draw.n), raised - bent - 35 + draw.normal(20)], 1)
    roll = is_sideways * -draw.uniform(0, 25)
    is_swapped = draw.chance(0.5)
    thigh, knee, spread, foot = _swapped(is_swapped, thigh, knee, spread, foot)
    roll = np.where(is_swapped, -roll, roll)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.goals(_BALANCING_ARMS),
        foot=foot,
        spread=spread,
        turnout=6 + draw.normal(13, 2),
        pitch=pitch,
        roll=roll + draw.normal(5),
        bend=draw.half_normal(14) - np.where(is_behind, 8.0, 0.0),
        twist=draw.normal(16),
        lean=draw.normal(10) + 0.5 * roll,
    )


def kneel(draw: Draw) -> Posture:
    """On both knees, upright to sitting on the heels; or, four in ten, on one knee."""
    knee = draw.uniform(85, 148)[:, None] + draw.normal(5, 2)
    thigh = knee - 90 + draw.normal(5, 2)
    is_front = draw.chance(0.4)[:, None] & draw.sides(np.ones(draw.n, bool), np.zeros(draw.n, bool))
    thigh = np.where(is_front, draw.uniform(70, 100, 2), thigh)
    knee = np.where(is_front, draw.uniform(75, 110, 2), knee)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.goals(_FREE_ARMS),
        foot=np.where(is_front, 0.0, thigh - knee - 20) + draw.normal(8, 2),
        spread=3 + draw.half_normal(8, 2),
        turnout=3 + draw.normal(8, 2),
        pitch=4 + draw.normal(8) + draw.chance(0.3) * draw.uniform(0, 40),
        roll=draw.normal(4),
        bend=draw.half_normal(14),
        twist=draw.normal(15),
        lean=draw.normal(8),
    )


def crawl(draw: Draw) -> Posture:
    """On hands and knees, or one in five on hands and feet, the arms straight down, the head raised to look ahead."""
    on_feet = draw.chance(0.2)
    thigh = np.where(on_feet[:, None], draw.uniform(0, 45, 2), draw.uniform(-30, 35, 2))
    knee = np.where(on_feet[:, None], draw.uniform(5, 60, 2), 90 + thigh + draw.normal(9, 2))
    # Arms are longer than thighs and shorter than legs.
    pitch = np.where(on_feet, 106, 78) + draw.normal(9)
    bend = draw.normal(12)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.goals({"support": 1.0}),
        foot=np.where(on_feet[:, None], -20, thigh - knee - 25) + draw.normal(12, 2),
        spread=3 + draw.half_normal(8, 2),
        turnout=3 + draw.normal(7, 2),
        pitch=pitch,
        roll=draw.normal(6),
        bend=bend,
        twist=draw.normal(12),
        lean=draw.normal(9),
        nod=-35 + draw.normal(20),
        drop=90 - pitch - 0.75 * bend,
    )


def lie(draw: Draw) -> Posture:
    """On the back, the front or a side; legs out or, half the time, drawn up; arms on the floor or off it."""
    way = draw.uniform(0, 1)
    is_prone, is_aside = way < 0.3, way > 0.7
    facing = np.where(is_prone | (is_aside & draw.chance(0.5)), 90.0, -90.0)
    on_side = is_aside * np.where(draw.chance(0.5), 1.0, -1.0) * draw.uniform(60, 95)
    drawn_up = draw.chance(0.5)[:, None] * draw.uniform(0, 100, 2) * np.where(is_prone, 0.2, 1.0)[:, None]
    hip, knee = drawn_up + draw.normal(5, 2), 1.25 * drawn_up + draw.half_normal(8, 2)
    pitch = facing + draw.normal(3)
    goals = np.where(is_prone[:, None], draw.goals(_PRONE_ARMS), draw.goals(_SUPINE_ARMS))
    return Posture(
        thigh=hip - pitch[:, None],
        knee=knee,
        goals=np.where(is_aside[:, None], draw.goals(_ASIDE_ARMS), goals),
        foot=hip - pitch[:, None] - knee - 20 + draw.normal(10, 2),
        spread=4 + draw.half_normal(9, 2) * np.where(is_aside, 0.3, 1.0)[:, None],
        turnout=8 + draw.normal(14, 2),
        pitch=pitch,
        turn=on_side,
        bend=draw.normal(7),
        twist=draw.normal(12),
        lean=draw.normal(8),
    )


def dance(draw: Draw) -> Posture:
    """On turned-out legs: knees bent together, or one leg raised to the front, the side or behind; arms in position."""
    way = draw.uniform(0, 1)
    is_bent, is_behind, is_sideways = way < 0.3, (way >= 0.3) & (way < 0.55), way > 0.8
    raised = draw.uniform(10, 100)
    plie = draw.uniform(10, 110) * draw.chance(0.7)
    standing = draw.half_normal(6) + draw.chance(0.25) * draw.uniform(0, 50)
    forward = np.where(is_behind, -0.75 * raised, np.where(is_sideways, draw.normal(15), raised))
    folded = draw.chance(0.35) * draw.uniform(20, 120) + draw.half_normal(6)
    half = 0.5 * plie
    thigh = np.stack([np.where(is_bent, half, 0.5 * standing), np.where(is_bent, half, forward)], 1)
    knee = np.stack([np.where(is_bent, plie, standing), np.where(is_bent, plie, folded)], 1)
    open_legs = is_bent * (6 + 0.35 * plie)
    spread = np.stack([open_legs, np.where(is_sideways, 0.85 * raised, open_legs)], 1)
    spread = spread + draw.half_normal(6, 2)
    # Pointed toes, or a level foot under the weight, up on its ball half the time.
    level = draw.chance(0.4) * draw.uniform(-50, 0)
    foot = np.stack([level, np.where(is_bent, level, thigh[:, 1] - knee[:, 1] - 45)], 1)
    pitch = draw.normal(5) + np.where(is_behind, 0.55 * raised, np.where(is_bent, 0.0, -0.1 * raised))
    roll = -is_sideways.astype(float) * draw.uniform(0, 0.35) * raised
    is_swapped = draw.chance(0.5)
    thigh, knee, spread, foot = _swapped(is_swapped, thigh, knee, spread, foot)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.positions(_DANCE_POSITIONS),
        foot=foot,
        spread=spread,
        turnout=28 + draw.normal(12, 2),
        pitch=pitch,
        roll=np.where(is_swapped, -roll, roll),
        bend=draw.normal(10) - np.where(is_behind, 0.35 * raised, 0.0),
        twist=draw.normal(14),
        lean=draw.normal(12),
        nod=draw.normal(8),
    )


def climb(draw: Draw) -> Posture:
    """Hands on something above or before the face, one foot or both drawn up to the next step."""
    step = draw.uniform(20, 110)
    other = draw.uniform(0, 60)
    thigh = draw.sides(step, other * draw.uniform(0.2, 1.0))
    knee = (thigh + draw.uniform(-10, 30)[:, None] + draw.normal(8, 2)).clip(0)
    return Posture(
        thigh=thigh,
        knee=knee,
        goals=draw.goals(_CLIMBING_ARMS),
        foot=draw.normal(12, 2) - 10,
        spread=4 + draw.half_normal(10, 2),
        turnout=8 + draw.normal(12, 2),
        pitch=draw.normal(8),
        roll=draw.normal(6),
        bend=5 + draw.normal(12),
        twist=draw.normal(16),
        lean=draw.normal(12),
        nod=-10 + draw.normal(15),
    )


FAMILIES: dict[str, Callable[[Draw], Posture]] = {
    family.__name__: family
    for family in (stand, walk, run, squat, lunge, sit, kick, kneel, crawl, lie, dance, climb)
}
"""The families by name."""
