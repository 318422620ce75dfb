"""Left and right exchanged: the main failure of the thesis's system (chapter 4), found and mended over time.

A person seen from behind looks much like one seen from the front, and a network that takes one for the other exchanges
the sides of the whole body. The person in the frame before had the sides where they are now, and a mesh that faces the
wrong way fits the depth worse. The depth is asked where the frame before says otherwise, where there is none, and twice
a second: sides that stay exchanged while a person turns agree from frame to frame.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ljn.body.skeleton import MIRROR
from ljn.geometry.distance import distances_to_mesh
from ljn.pipeline.prediction import Prediction

_BETTER = 0.8  # a fit to the depth that is this much better is clear
_PATIENCE = 5  # corrections in a row, after which the frames before may be what was wrong
_MEMORY_S = 0.5  # a person may turn about in a longer gap
_SURE_S = 0.5  # so long the frames before are trusted without a look at the depth
_MAX_POINTS = 500  # of the cloud, of which the fit is taken


class Judged(NamedTuple):
    """A prediction, and what was found of its sides.

    Attributes:
        prediction: The one to take.
        flip: `""` (nothing was found), `corrected` (the sides were exchanged, and are not now) or `unclear`.
    """

    prediction: Prediction
    flip: str


@dataclass
class FlipJudge:
    """Watches one person's predictions, frame after frame."""

    joints: np.ndarray | None = None  # `(24, 3)` of the frame before, metres, camera frame
    seconds: float = 0.0  # when that was
    num_corrected: int = 0  # in a row
    compared_s: float = -np.inf  # when both ways round were held against the depth

    def __call__(
        self,
        prediction: Prediction,
        seconds: float,
        again: Callable[[np.ndarray], Prediction],
    ) -> Judged:
        """Judge the prediction of the next frame.

        Args:
            prediction: As found.
            seconds: When.
            again: Predicts the same frame once more, begun from joints `(24, 3)`, metres, camera frame.
        """
        judged = self._judged(prediction, seconds, again)
        self.num_corrected = self.num_corrected + 1 if judged.flip == "corrected" else 0
        self.joints, self.seconds = judged.prediction.joints, seconds
        return judged

    def _judged(
        self, prediction: Prediction, seconds: float, again: Callable[[np.ndarray], Prediction]
    ) -> Judged:
        is_first = self.joints is None or seconds - self.seconds > _MEMORY_S
        is_exchanged = not is_first and self._looks_exchanged(prediction.joints)
        if not is_first and not is_exchanged and seconds - self.compared_s <= _SURE_S:
            return Judged(prediction, "")
        other = again(prediction.joints[list(MIRROR)])
        advantage = _misfit(prediction) / max(_misfit(other), 1e-9)  # above 1, the other fits better
        self.compared_s = seconds
        if not is_exchanged:
            # The frame before says nothing, or was wrong, too. The other is the same, where the detector has found
            # the way back by itself.
            return Judged(other, "corrected") if advantage > 1 / _BETTER else Judged(prediction, "")
        if self._distance(other.joints) >= self._distance(prediction.joints):
            return Judged(prediction, "unclear")
        if advantage < _BETTER or (self.num_corrected >= _PATIENCE and advantage < 1 / _BETTER):
            return Judged(
                prediction, "unclear"
            )  # the person, or the frames before, had it the other way round
        return Judged(other, "corrected")

    def _looks_exchanged(self, joints: np.ndarray) -> bool:
        return self._distance(joints[list(MIRROR)]) < self._distance(joints)

    def _distance(self, joints: np.ndarray) -> float:
        assert self.joints is not None
        return float(np.linalg.norm(joints - self.joints, axis=-1).mean())


def _misfit(prediction: Prediction) -> float:
    """Median distance of the cloud from the mesh, metres; 1 without a mesh, so that nothing is better or worse."""
    if prediction.vertices is None or prediction.faces is None:
        return 1.0
    points = prediction.points[:_MAX_POINTS, :3]  # they are in random order
    return float(np.median(distances_to_mesh(points, prediction.vertices, prediction.faces)))
