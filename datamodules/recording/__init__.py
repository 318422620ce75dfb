"""Recordings that are rendered: a person before a green curtain, as an RGB-D sensor sees it, with the truth."""

from datamodules.recording.stage import Curtain
from datamodules.recording.synthetic import SyntheticRecording, Truth
from datamodules.recording.writing import write_recording

__all__ = ["Curtain", "SyntheticRecording", "Truth", "write_recording"]
