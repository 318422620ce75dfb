"""A mesh fitted to the depth image that it was guessed from (ours, beyond the thesis)."""

from ljn.refinement.looks import refine, second_look
from ljn.refinement.refiner import SETTINGS, Refined, RefinementSettings, Refiner, chosen_settings

__all__ = ["SETTINGS", "Refined", "RefinementSettings", "Refiner", "chosen_settings", "refine", "second_look"]
