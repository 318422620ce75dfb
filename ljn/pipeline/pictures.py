"""A picture of a prediction, to see at a glance whether it is any good."""

from typing import TYPE_CHECKING

import numpy as np

from ljn.body.skeleton import ROOT
from ljn.drawing import FROM_THE_SIDE, add_legend, bone_lines, new_figure
from ljn.geometry.camera import Camera
from ljn.pipeline.prediction import Prediction
from ljn.render.shading import shade_mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INITIAL, _PREDICTED, _FILLED = "#8f9aa8", "#d62728", "#ff9f1c"
MESH = (0.45, 0.62, 0.86)
_MESH_OPACITY = 0.75
NEAREST_M = 0.1
_BESIDE = Camera(fx=400, fy=400, cx=512, cy=512, width=1024, height=1024)


def draw_prediction(prediction: Prediction, depth: np.ndarray, camera: Camera) -> "Figure":
    """A page of one image's prediction: keypoints on the depth, skeleton in the cloud, mesh; front and side.

    `depth` is `(H, W)`, metres, 0 is background.
    """
    has_mesh = prediction.vertices is not None
    figure = new_figure(15 if has_mesh else 9, 5)
    axes = figure.subplots(1, 5 if has_mesh else 3)
    _draw_keypoints(axes[0], prediction, depth)
    for axis, horizontal, view in ((axes[1], 0, "front"), (axes[2], 2, "side")):
        _draw_skeletons(axis, prediction, horizontal)
        axis.set_title(f"cloud and joints, {view}", fontsize=9, loc="left")
    if has_mesh:
        _draw_meshes(axes[3], axes[4], prediction, depth, camera)
    handles = [
        axes[1].plot([], [], color=_INITIAL, lw=2, label="lifted keypoints")[0],
        axes[1].plot([], [], color=_PREDICTED, lw=2, label="predicted joints")[0],
        axes[1].plot([], [], color=_FILLED, lw=0, marker="o", ms=4, label="filled-in keypoints")[0],
    ]
    add_legend(figure, handles)
    return figure


def _draw_keypoints(axis: "Axes", prediction: Prediction, depth: np.ndarray) -> None:
    axis.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis")
    keypoints = prediction.keypoints
    if keypoints is not None:
        is_filled = prediction.confidences == 0
        axis.plot(*bone_lines(keypoints).T, color="white", lw=0.6)
        for chosen, colour in ((~is_filled, _PREDICTED), (is_filled, _FILLED)):
            axis.scatter(keypoints[chosen, 0], keypoints[chosen, 1], s=9, c=colour, zorder=3)
    _crop(axis, depth > 0, keypoints)
    axis.set_title("depth and 2D keypoints", fontsize=9, loc="left")


def _crop(axis: "Axes", is_shown: np.ndarray, pixels: np.ndarray | None) -> None:
    """Leave of an image what is shown `(H, W)` and the pixels `(K, 2)`, if there are any, with a border."""
    shown = np.argwhere(is_shown)[:, ::-1]
    if pixels is not None:
        shown = np.concatenate([shown, pixels])
    low, high = shown.min(0) - 5, shown.max(0) + 5
    axis.set_xlim(low[0], high[0])
    axis.set_ylim(high[1], low[1])
    axis.set_axis_off()


def _draw_skeletons(axis: "Axes", prediction: Prediction, horizontal: int) -> None:
    """`horizontal`: the camera axis that goes to the right (0 from the front, 2 from the side)."""
    points = prediction.points
    axis.scatter(points[:, horizontal], points[:, 1], s=2, c="#b9bec6", linewidths=0)
    for joints, colour in ((prediction.initial_joints, _INITIAL), (prediction.joints, _PREDICTED)):
        if joints is None:
            continue
        bones = bone_lines(joints)
        axis.plot(bones[:, horizontal], bones[:, 1], color=colour, lw=1.6, solid_capstyle="round")
    axis.set_aspect("equal")
    axis.invert_yaxis()
    axis.set_axis_off()


def _draw_meshes(
    front: "Axes", side: "Axes", prediction: Prediction, depth: np.ndarray, camera: Camera
) -> None:
    vertices, faces = prediction.vertices, prediction.faces
    assert vertices is not None
    assert faces is not None
    if vertices[:, 2].min() < NEAREST_M:
        front.set_axis_off()
        side.set_axis_off()
        front.set_title("the mesh is not before the camera", fontsize=9, loc="left")
        return
    colours = shade_mesh(vertices, faces, camera, MESH, background=np.nan)
    is_mesh = np.isfinite(colours[..., 0])
    body = depth[depth > 0]
    grey = np.where(depth > 0, 0.9 - 0.5 * (depth - body.min()) / max(float(np.ptp(body)), 1e-6), 1.0)
    over_grey = _MESH_OPACITY * colours + (1 - _MESH_OPACITY) * grey[..., None]
    front.imshow(np.where(is_mesh[..., None], over_grey, grey[..., None]))
    _crop(front, is_mesh | (depth > 0), prediction.keypoints)
    front.set_title("mesh over the depth image", fontsize=9, loc="left")

    # Seen from as far as by the camera, with the root in the middle of the picture.
    root = prediction.joints[ROOT]
    distance = np.array([0, 0, max(root[2], 1.5)])
    turned = (vertices - root) @ FROM_THE_SIDE.T + distance
    colours = shade_mesh(turned, faces, _BESIDE, MESH)
    points = (prediction.points[:, :3] - root) @ FROM_THE_SIDE.T + distance
    pixels = points[:, :2] / points[:, 2:] * _BESIDE.fx + _BESIDE.cx
    side.imshow(colours)
    side.scatter(pixels[:, 0], pixels[:, 1], s=0.8, c="black", alpha=0.35, linewidths=0)
    _crop(side, np.any(colours < 1, axis=-1), pixels)
    side.set_title("mesh and cloud, side", fontsize=9, loc="left")
