"""Drawings of clouds, skeletons and depth images, without a display."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from torch import Tensor

from ljn.body.skeleton import BONES
from ljn.data import Batch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRUE, _PREDICTED, _CLOUD = "#1f5fd6", "#d62728", "#b9bec6"


def new_figure(width: float, height: float) -> "Figure":
    """An empty matplotlib figure; sizes in inches, at 100 dots an inch."""
    # Not through pyplot: its figures belong to a global state and, on some machines, to a screen.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


class Sample(NamedTuple):
    """What is drawn of a sample; camera frame, metres.

    Attributes:
        points: `(N, 3)`.
        joints: `(24, 3)`, the truth.
        pred_joints: `(24, 3)`.
        title: Text above it.
    """

    points: np.ndarray
    joints: np.ndarray
    pred_joints: np.ndarray
    title: str


def draw_samples(samples: list[Sample], num_columns: int) -> "Figure":
    """A page of samples, each from the front (the camera's view) and from the side.

    Args:
        samples: What to draw, in reading order.
        num_columns: Samples in a row.

    Returns:
        A matplotlib figure, made without a display.
    """
    num_rows = -(-len(samples) // num_columns)
    figure = new_figure(3.8 * num_columns, 2.3 * num_rows + 0.3)
    axes = figure.subplots(num_rows, 2 * num_columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for number, sample in enumerate(samples):
        row, column = divmod(number, num_columns)
        front, side = axes[row, 2 * column], axes[row, 2 * column + 1]
        _draw_view(front, sample, horizontal=0)
        _draw_view(side, sample, horizontal=2)
        front.set_title(sample.title, fontsize=9, loc="left")
    figure.legend(
        handles=[
            axes[0, 0].plot([], [], color=_TRUE, lw=2, label="true")[0],
            axes[0, 0].plot([], [], color=_PREDICTED, lw=2, label="predicted")[0],
        ],
        loc="outside lower center",
        ncols=2,
        fontsize=9,
        frameon=False,
    )
    return figure


def _draw_view(axis: "Axes", sample: Sample, horizontal: int) -> None:
    """One view: `horizontal` is the camera axis that goes to the right (0 from the front, 2 from the side)."""
    axis.scatter(sample.points[:, horizontal], sample.points[:, 1], s=0.6, c=_CLOUD, linewidths=0)
    for joints, colour in ((sample.joints, _TRUE), (sample.pred_joints, _PREDICTED)):
        for parent, joint in BONES:
            ends = joints[[parent, joint]]
            axis.plot(ends[:, horizontal], ends[:, 1], color=colour, lw=1.6, solid_capstyle="round")
    everything = np.concatenate([sample.points, sample.joints, sample.pred_joints])
    centre = (everything.min(0) + everything.max(0)) / 2
    half = 0.52 * float(np.ptp(everything, axis=0).max())
    axis.set_xlim(centre[horizontal] - half, centre[horizontal] + half)
    axis.set_ylim(centre[1] + half, centre[1] - half)  # y points down
    axis.set_aspect("equal")


def draw_examples(batch: Batch, depth: Tensor) -> "Figure":
    """A page of training samples, two a row: depth image with keypoints, cloud with normals, initial joints.

    Args:
        batch: B samples.
        depth: `(B, H, W)`, metres, 0 where there is no body.

    Returns:
        A matplotlib figure. True keypoints and joints are blue, noisy and initial ones red; a point's colour
        is its normal (x, y, z as red, green, blue).
    """
    num_columns = 2
    num_rows = -(-len(depth) // num_columns)
    figure = new_figure(8.0 * num_columns, 3.4 * num_rows)
    axes = figure.subplots(num_rows, 4 * num_columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    arrays = {name: value.numpy() for name, value in batch.items()}  # type: ignore[attr-defined]
    for number, image in enumerate(depth.numpy()):
        row, column = divmod(number, num_columns)
        first, cloud, front, side = axes[row, 4 * column : 4 * column + 4]
        body = image > 0
        first.imshow(np.where(body, image, np.nan), cmap="viridis")
        first.set_axis_on()
        first.set(xticks=[], yticks=[])
        first.scatter(*arrays["keypoints_2d"][number].T, s=5, c=_TRUE)
        first.scatter(*arrays["noisy_keypoints_2d"][number].T, s=5, c=_PREDICTED)
        first.set_title(
            f"sample {arrays['sample_id'][number]}: {image[body].min():.2f} m away", fontsize=9, loc="left"
        )
        points, normals = np.split(arrays["points"][number], 2, axis=-1)
        cloud.scatter(points[:, 0], points[:, 1], s=1.5, c=(normals + 1) / 2, linewidths=0)
        cloud.set_aspect("equal")
        cloud.invert_yaxis()
        sample = Sample(points, arrays["joints"][number], arrays["initial_joints"][number], "")
        _draw_view(front, sample, horizontal=0)
        _draw_view(side, sample, horizontal=2)
    return figure
