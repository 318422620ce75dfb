"""What real depth cameras and real people do to a depth image: a chain of small steps, each with its own switch."""

from datamodules.sensor.body import Clothing, Tilt, WideShapes
from datamodules.sensor.chain import Sensor, Shot, Step
from datamodules.sensor.measuring import (
    AxialNoise,
    Disparity,
    FlyingPixels,
    Grazing,
    Holes,
    Lateral,
    Multipath,
    Range,
    Shadow,
)
from datamodules.sensor.surroundings import CutOff, Floor, HeldObject, LostLimb, MaskErrors, Occluder

__all__ = [
    "AxialNoise",
    "Clothing",
    "CutOff",
    "Disparity",
    "Floor",
    "FlyingPixels",
    "Grazing",
    "HeldObject",
    "Holes",
    "Lateral",
    "LostLimb",
    "MaskErrors",
    "Multipath",
    "Occluder",
    "Range",
    "Sensor",
    "Shadow",
    "Shot",
    "Step",
    "Tilt",
    "WideShapes",
]
