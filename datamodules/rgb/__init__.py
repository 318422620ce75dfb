"""Colour crops of rendered bodies: a person's look, light, background, camera and mask, each with its own switch."""

from datamodules.rgb.backgrounds import Background
from datamodules.rgb.chain import ColourStep, Photo, Photography
from datamodules.rgb.frames import FrameSynthesizer
from datamodules.rgb.module import RgbDataModule
from datamodules.rgb.photography import Defocus, Jpeg, LowResolution, MaskErrors, Motion, Noise, Tone
from datamodules.rgb.styling import Garments, Hair, Lights, Patterns, Skin
from datamodules.rgb.synthesis import RgbSettings, RgbSynthesizer

__all__ = [
    "Background",
    "ColourStep",
    "Defocus",
    "FrameSynthesizer",
    "Garments",
    "Hair",
    "Jpeg",
    "Lights",
    "LowResolution",
    "MaskErrors",
    "Motion",
    "Noise",
    "Patterns",
    "Photo",
    "Photography",
    "RgbDataModule",
    "RgbSettings",
    "RgbSynthesizer",
    "Skin",
    "Tone",
]
