"""Drawings of clouds, skeletons and depth images, without a display."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ljn.body.skeleton import BONES, JOINT_NAMES
from ljn.geometry.camera import Camera, back_project, project
from ljn.render.shading import shade_mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ljn.data import Batch

_TRUE, _PREDICTED, _CLOUD = "#1f5fd6", "#d62728", "#b9bec6"
FROM_THE_SIDE = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""The camera's axes turned about the vertical, so that what is far lies to the right."""


def new_figure(width: float, height: float) -> "Figure":
    """An empty matplotlib figure; sizes in inches, at 100 dots an inch."""
    # Not through pyplot: its figures belong to a global state and, on some machines, to a screen.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


class Sample(NamedTuple):
    """What is drawn of a sample; camera frame, metres."""

    points: np.ndarray  # `(N, 3)`
    joints: np.ndarray  # `(24, 3)`, the truth
    pred_joints: np.ndarray  # `(24, 3)`
    title: str  # text above it


def draw_samples(samples: list[Sample], num_columns: int) -> "Figure":
    """A page of samples in reading order, each from the front (the camera's view) and from the side."""
    num_rows = -(-len(samples) // num_columns)
    figure, axes = _page(len(samples), num_columns, 2, 3.8 * num_columns, 2.3 * num_rows + 0.3)
    for (front, side), sample in zip(axes, samples):
        _draw_view(front, sample, horizontal=0)
        _draw_view(side, sample, horizontal=2)
        front.set_title(sample.title, fontsize=9, loc="left")
    lines = ({"color": _TRUE, "label": "true"}, {"color": _PREDICTED, "label": "predicted"})
    add_legend(figure, [axes[0, 0].plot([], [], lw=2, **line)[0] for line in lines])
    return figure


def _page(
    num_samples: int, num_columns: int, num_panels: int, width: float, height: float
) -> tuple["Figure", np.ndarray]:
    """An empty figure, and a sample's panels in each row of its axes `(num_rows * num_columns, num_panels)`."""
    figure = new_figure(width, height)
    axes = figure.subplots(-(-num_samples // num_columns), num_panels * num_columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    return figure, axes.reshape(-1, num_panels)


def add_legend(figure: "Figure", handles: list[Any]) -> None:
    """Name lines in one row below a figure's axes."""
    style: dict[str, Any] = {"fontsize": 9, "frameon": False, "ncols": len(handles)}
    figure.legend(handles=handles, loc="outside lower center", **style)


def bone_lines(joints: np.ndarray) -> np.ndarray:
    """The bones of joints `(24, D)` as one line with gaps, for one `plot`: each by itself takes ten times as long.

    `(3 * 23, D)`: both ends of each bone, then NaN.
    """
    bones = np.pad(joints[np.array(BONES)], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
    return bones.reshape(-1, joints.shape[-1])


def _draw_view(axis: "Axes", sample: Sample, horizontal: int) -> None:
    """One view: `horizontal` is the camera axis that goes to the right (0 from the front, 2 from the side)."""
    axis.scatter(sample.points[:, horizontal], sample.points[:, 1], s=0.6, c=_CLOUD, linewidths=0)
    for joints, colour in ((sample.joints, _TRUE), (sample.pred_joints, _PREDICTED)):
        bones = bone_lines(joints)
        axis.plot(bones[:, horizontal], bones[:, 1], color=colour, lw=1.6, solid_capstyle="round")
    everything = np.concatenate([sample.points, sample.joints, sample.pred_joints])
    centre = (everything.min(0) + everything.max(0)) / 2
    half = 0.52 * float(np.ptp(everything, axis=0).max())
    axis.set_xlim(centre[horizontal] - half, centre[horizontal] + half)
    axis.set_ylim(centre[1] + half, centre[1] - half)  # y points down
    axis.set_aspect("equal")


def clouds(batch: Mapping[str, Tensor]) -> list[np.ndarray]:
    """What was seen of each sample of a batch as points `(N, 3)`, metres, camera frame: its cloud, or else its crop.

    Of batches with neither, no points.
    """
    if "points" in batch:
        return list(batch["points"][..., :3].numpy())
    if "crop" not in batch:
        return [np.empty((0, 3), np.float32)] * len(batch["sample_id"])
    seen = []
    for crop, camera in zip(batch["crop"], batch["crop_camera"]):
        v, u = crop.nonzero(as_tuple=True)
        seen.append(back_project(torch.stack([u, v], -1).float(), crop[v, u], camera).numpy())
    return seen


class MeshSample(NamedTuple):
    """What is drawn of a mesh regressor's sample; camera frame, metres."""

    points: np.ndarray  # `(N, 3)`
    vertices: np.ndarray  # `(V, 3)`, the truth
    pred_vertices: np.ndarray  # `(V, 3)`
    title: str  # text above it


def draw_meshes(samples: list[MeshSample], faces: np.ndarray, num_columns: int) -> "Figure":
    """A page of samples (Fig. 3.13): predicted (red) beside true (blue) mesh, front and side, the cloud over them.

    All meshes have the faces `(F, 3)`.
    """
    num_rows = -(-len(samples) // num_columns)
    figure, axes = _page(len(samples), num_columns, 4, 6.0 * num_columns, 2.3 * num_rows)
    for of_sample, sample in zip(axes, samples):
        middle = (sample.vertices.min(0) + sample.vertices.max(0)) / 2
        size_m = 1.1 * float(np.ptp(np.concatenate([sample.vertices, sample.pred_vertices]), axis=0).max())
        panels = [
            (view, vertices, colour)
            for view in (np.eye(3), FROM_THE_SIDE)
            for vertices, colour in (
                (sample.pred_vertices, (0.90, 0.55, 0.50)),
                (sample.vertices, (0.55, 0.68, 0.92)),
            )
        ]
        camera = _panel_camera(size_m)
        for axis, (view, vertices, colour) in zip(of_sample, panels):
            seen = (vertices - middle) @ view.T + np.array([0, 0, _PANEL_DISTANCE_M])
            axis.imshow(shade_mesh(seen, faces, camera, colour))
            _draw_cloud_over(axis, (sample.points - middle) @ view.T, camera)
        of_sample[0].set_title(sample.title, fontsize=9, loc="left")
    return figure


_PANEL_PX = 220
_PANEL_DISTANCE_M = 4.0


def _panel_camera(size_m: float) -> Camera:
    focal = _PANEL_PX / size_m * _PANEL_DISTANCE_M
    centre = (_PANEL_PX - 1) / 2
    return Camera(focal, focal, centre, centre, _PANEL_PX, _PANEL_PX)


def _draw_cloud_over(axis: "Axes", points: np.ndarray, camera: Camera) -> None:
    seen = points + np.array([0, 0, _PANEL_DISTANCE_M])
    u, v = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
    axis.scatter(u, v, s=0.4, c="black", alpha=0.25, linewidths=0)


class CropSample(NamedTuple):
    """What is drawn of a keypoint detector's sample; pixels of the crop."""

    image: np.ndarray  # `(H, W, 3)` uint8, or `(H, W)` depth, metres, 0 outside the body
    keypoints: np.ndarray  # `(24, 2)`, the truth
    pred_keypoints: np.ndarray  # `(24, 2)`
    title: str  # text above it


def draw_crops(samples: list[CropSample], num_columns: int) -> "Figure":
    """A page of crops in reading order with true (blue) and predicted (red) skeletons; the left side's are thick."""
    num_rows = -(-len(samples) // num_columns)
    figure, axes = _page(len(samples), num_columns, 1, 2.6 * num_columns, 2.9 * num_rows + 0.3)
    for (axis,), sample in zip(axes, samples):
        is_depth = sample.image.ndim == 2
        image = np.where(sample.image > 0, sample.image, np.nan) if is_depth else sample.image
        axis.imshow(image, cmap="gray")
        for keypoints, colour in ((sample.keypoints, _TRUE), (sample.pred_keypoints, _PREDICTED)):
            draw_skeleton(axis, keypoints, colour)
        height, width = sample.image.shape[:2]
        axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axis.set_title(sample.title, fontsize=9, loc="left")
    lines = ({"color": _TRUE, "label": "true"}, {"color": _PREDICTED, "label": "predicted (left side thick)"})
    add_legend(figure, [axes[0, 0].plot([], [], lw=2, **line)[0] for line in lines])
    return figure


def draw_skeleton(axis: "Axes", keypoints: np.ndarray, colour: str) -> None:
    """The bones between keypoints `(24, 2)`, pixels; those of the left side are thicker, so that flips can be seen."""
    for side, width in (("l_", 2.2), ("", 1.2)):
        bones = [bone for bone in BONES if JOINT_NAMES[bone[1]].startswith("l_") == bool(side)]
        lines = np.pad(keypoints[np.array(bones)], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        axis.plot(*lines.reshape(-1, 2).T, color=colour, lw=width, solid_capstyle="round")


def draw_examples(batch: "Batch", depth: Tensor) -> "Figure":
    """A page of B training samples, two a row: depth image with keypoints, cloud with normals, initial joints.

    `depth` is `(B, H, W)`, metres, 0 where there is no body. True keypoints and joints are blue, noisy and initial ones
    red; a point's colour is its normal (x, y, z as red, green, blue).
    """
    figure, axes = _page(len(depth), 2, 4, 16.0, 3.4 * -(-len(depth) // 2))
    arrays = {name: value.numpy() for name, value in batch.items()}  # type: ignore[attr-defined]
    for number, image in enumerate(depth.numpy()):
        first, cloud, front, side = axes[number]
        body = image > 0
        first.imshow(np.where(body, image, np.nan), cmap="viridis")
        first.set_axis_on()
        first.set(xticks=[], yticks=[])
        first.scatter(*arrays["true_keypoints"][number].T, s=5, c=_TRUE)
        first.scatter(*arrays["keypoints"][number].T, s=5, c=_PREDICTED)
        title = f"sample {arrays['sample_id'][number]}: {image[body].min():.2f} m away"
        first.set_title(title, fontsize=9, loc="left")
        points, normals = np.split(arrays["points"][number], 2, axis=-1)
        cloud.scatter(points[:, 0], points[:, 1], s=1.5, c=(normals + 1) / 2, linewidths=0)
        cloud.set_aspect("equal")
        cloud.invert_yaxis()
        sample = Sample(points, arrays["joints"][number], arrays["initial_joints"][number], "")
        _draw_view(front, sample, horizontal=0)
        _draw_view(side, sample, horizontal=2)
    return figure


def draw_crops(batch: "Batch") -> "Figure":
    """A page of B colour crops, eight a row, each beside itself with its true joints."""
    number, columns = len(batch["rgb"]), 8
    figure, axes = _page(number, columns, 2, 2.0 * columns, 1.6 * -(-number // columns))
    keypoints = project(batch["joints"], batch["rgb_camera"]).numpy()
    for (plain, marked), crop, joints in zip(axes, batch["rgb"].permute(0, 2, 3, 1).numpy(), keypoints):
        for axis in (plain, marked):
            axis.imshow(crop)
        marked.plot(*bone_lines(joints).T, color=_TRUE, lw=1.0, marker=".", ms=3)
        marked.set(xlim=plain.get_xlim(), ylim=plain.get_ylim())
    return figure
