"""Pictures of several predictions on a page, and of one mesh that turns."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from ljn.body.skeleton import ROOT
from ljn.drawing import FROM_THE_SIDE, new_figure
from ljn.geometry.camera import Camera
from ljn.pipeline.pictures import MESH, NEAREST_M
from ljn.pipeline.prediction import Prediction
from ljn.render import get_renderer
from ljn.render.shading import shade_mesh

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PX_PER_METRE = 145.0
_SUBPIXELS = 2  # a pixel is the mean of as many squared
_MARGIN_PX = 14
_TOP_PX, _BOTTOM_PX, _LEFT_PX, _GAP_PX = 62, 44, 34, 22
_OPACITY = 0.82
_DOT_PX = 1.1  # radius of a point of the cloud
_SEEN_M = 0.02  # a point this far behind the surface is still seen
_INK, _FAINT, _LINE = "#20242a", "#6b7480", "#dde1e6"
_GIF_PX = 420  # the longer side
_GIF_FRAME_MS = 90
_GIF_COLOURS = 96
_TILT = np.deg2rad(12)


class Panel(NamedTuple):
    """A prediction and what is written about it.

    Attributes:
        prediction: With a mesh.
        depth: `(H, W)`, metres; 0 is background.
        camera: The camera.
        title: Above it.
        subtitle: Below the title.
        caption: Below the pictures.
    """

    prediction: Prediction
    depth: np.ndarray
    camera: Camera
    title: str
    subtitle: str
    caption: str


def draw_overview(panels: list[Panel]) -> "Figure":
    """A page with a column for each frame: the depth image, the mesh over it, mesh and cloud from the side.

    All at one scale. The clouds' colours are those of the depth images.
    """
    columns = [[_depth(panel), _over_depth(panel), _from_the_side(panel)] for panel in panels]
    widths = [max(image.shape[1] for image in column) for column in columns]
    heights = [max(column[row].shape[0] for column in columns) for row in range(3)]
    lefts = _LEFT_PX + np.cumsum([0, *(width + _GAP_PX for width in widths)])
    tops = _TOP_PX + np.cumsum([0, *(height + _GAP_PX for height in heights)])
    width, height = int(lefts[-1]) - _GAP_PX + _MARGIN_PX, int(tops[-1]) - _GAP_PX + _BOTTOM_PX
    page = np.ones((height, width, 3))
    for column, left, room in zip(columns, lefts, widths):
        for image, top, floor in zip(column, tops, heights):
            # All stand on the same line.
            y, x = top + floor - image.shape[0], left + (room - image.shape[1]) // 2
            page[y : y + image.shape[0], x : x + image.shape[1]] = image

    figure = new_figure(width / 100, height / 100)
    figure.set_layout_engine("none")
    axis = figure.add_axes((0, 0, 1, 1))
    axis.imshow(page, interpolation="none", aspect="auto", extent=(0, width, height, 0))
    axis.set_axis_off()
    for panel, left, room in zip(panels, lefts, widths):
        middle = left + room / 2
        axis.text(middle, 22, panel.title, color=_INK, fontsize=11, weight="bold", ha="center", va="center")
        axis.text(middle, 42, panel.subtitle, color=_FAINT, fontsize=8.5, ha="center", va="center")
        axis.text(middle, height - 20, panel.caption, color=_INK, fontsize=8.5, ha="center", va="center")
    for name, top, floor in zip(("depth image", "predicted mesh", "from the side"), tops, heights):
        axis.text(16, top + floor / 2, name, color=_FAINT, fontsize=9, rotation=90, ha="center", va="center")
        axis.plot([_LEFT_PX, width - _MARGIN_PX], [top + floor + 4] * 2, color=_LINE, lw=1)
    return figure


def _depth(panel: Panel) -> np.ndarray:
    """The depth image in colour, RGB in 0-1, cut to the body."""
    image = _magnified(panel, _viridis(panel.depth, panel.depth))
    return _shrunk(image, _magnified(panel, panel.depth > 0))


def _over_depth(panel: Panel) -> np.ndarray:
    """The mesh over the depth image in grey."""
    vertices, faces = _mesh(panel.prediction)
    is_body = _magnified(panel, panel.depth > 0)
    colours = np.full((*is_body.shape, 3), np.nan)
    if vertices[:, 2].min() > NEAREST_M:
        colours = shade_mesh(vertices, faces, _magnifying(panel), MESH, background=np.nan)
    is_mesh = np.isfinite(colours[..., 0])
    grey = np.where(is_body, 0.45 + 0.4 * (1 - _magnified(panel, _remoteness(panel.depth, panel.depth))), 1.0)
    over = _OPACITY * colours + (1 - _OPACITY) * grey[..., None]
    return _shrunk(np.where(is_mesh[..., None], over, grey[..., None]), is_mesh | is_body)


def _from_the_side(panel: Panel) -> np.ndarray:
    """The mesh and what of the cloud can be seen from the side; the camera is on the left."""
    distance = max(float(panel.prediction.joints[ROOT, 2]), 2.0)
    side = round(2.6 * _PX_PER_METRE * _SUBPIXELS)
    camera = _centred(_PX_PER_METRE * _SUBPIXELS * distance, side, side)
    centre = panel.prediction.joints[ROOT]
    image, is_drawn = _turned(panel.prediction, FROM_THE_SIDE, centre, distance, camera)
    return _shrunk(image, is_drawn)


def write_turntable(prediction: Prediction, path: Path, num_frames: int = 24) -> None:
    """Write a GIF of a prediction's mesh with its cloud, which turn once about the vertical."""
    from PIL import Image

    vertices, _ = _mesh(prediction)
    centre = (vertices.min(0) + vertices.max(0)) / 2
    turns = [
        _rotation(0, _TILT) @ _rotation(1, angle)
        for angle in np.arange(num_frames) * (2 * np.pi / num_frames)
    ]
    distance = 2 * float(np.linalg.norm(vertices - centre, axis=1).max()) + 1
    seen = np.stack([(vertices - centre) @ turn.T for turn in turns])
    reach = np.abs(seen[..., :2] / (seen[..., 2:] + distance)).max((0, 1))
    size = _GIF_PX * _SUBPIXELS
    focal = 0.45 * size / float(reach.max())
    width, height = (_SUBPIXELS * round(1.1 * 2 * focal * part / _SUBPIXELS) for part in reach.tolist())
    camera = _centred(focal, width, height)
    pictures = [_turned(prediction, turn, centre, distance, camera)[0] for turn in turns]
    frames = [
        Image.fromarray(np.rint(255 * np.clip(_joined(picture), 0, 1)).astype(np.uint8))
        for picture in pictures
    ]
    # One palette for all: colours that change from picture to picture flicker.
    sheet = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames]))
    palette = sheet.quantize(_GIF_COLOURS, method=Image.Quantize.MEDIANCUT)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first.save(path, save_all=True, append_images=others, duration=_GIF_FRAME_MS, loop=0, optimize=True)


def _turned(
    prediction: Prediction, rotation: np.ndarray, centre: np.ndarray, distance: float, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """A picture `(H, W, 3)` of mesh and cloud, turned about a centre, and where something is drawn `(H, W)`."""
    vertices, faces = _mesh(prediction)
    before = np.array([0, 0, distance])
    mesh = (vertices - centre) @ rotation.T + before
    image = shade_mesh(mesh, faces, camera, MESH, background=np.nan)
    is_drawn = np.isfinite(image[..., 0])
    image[~is_drawn] = 1.0
    surface = get_renderer("zbuffer")(torch.from_numpy(mesh)[None], torch.from_numpy(faces), camera)[
        0
    ].numpy()
    points = (prediction.points[:, :3] - centre) @ rotation.T + before
    pixels = points[:, :2] / points[:, 2:] * camera.fx + np.array([camera.cx, camera.cy])
    columns, rows = np.rint(pixels).astype(int).T
    radius = _DOT_PX * _SUBPIXELS
    reach = int(radius)
    is_seen = (reach <= columns) & (columns < camera.width - reach)
    is_seen &= (reach <= rows) & (rows < camera.height - reach)
    behind = surface[rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)]
    is_seen &= (behind == 0) | (points[:, 2] < behind + _SEEN_M)
    order = np.argsort(-points[:, 2])  # the nearest last, over the others
    order = order[is_seen[order]]
    colours = _viridis(prediction.points[order, 2], prediction.points[:, 2])
    for i, j in np.ndindex(2 * reach + 1, 2 * reach + 1):
        if (i - reach) ** 2 + (j - reach) ** 2 <= radius**2:
            place = rows[order] + i - reach, columns[order] + j - reach
            image[place], is_drawn[place] = colours, True
    return image, is_drawn


def _mesh(prediction: Prediction) -> tuple[np.ndarray, np.ndarray]:
    if prediction.vertices is None or prediction.faces is None:
        raise ValueError("prediction: expected one with a mesh; give the pipeline a mesh regressor")
    return prediction.vertices.astype(np.float64), prediction.faces


def _magnifying(panel: Panel) -> Camera:
    """The camera of a larger image of the same view, in which a metre at the root is as long as on the page."""
    camera = panel.camera
    factor = _PX_PER_METRE * _SUBPIXELS * float(panel.prediction.joints[ROOT, 2]) / camera.fx
    width, height = round(camera.width * factor), round(camera.height * factor)
    along_u, along_v = width / camera.width, height / camera.height
    return Camera(
        camera.fx * along_u,
        camera.fy * along_v,
        (camera.cx + 0.5) * along_u - 0.5,
        (camera.cy + 0.5) * along_v - 0.5,
        width,
        height,
    )


def _magnified(panel: Panel, image: np.ndarray) -> np.ndarray:
    """An image `(H, W, ...)` in the magnifying camera's size, each pixel as a square."""
    camera = _magnifying(panel)
    rows = (np.arange(camera.height) + 0.5) * panel.camera.height / camera.height
    columns = (np.arange(camera.width) + 0.5) * panel.camera.width / camera.width
    return image[rows.astype(int)[:, None], columns.astype(int)]


def _shrunk(image: np.ndarray, is_shown: np.ndarray) -> np.ndarray:
    """An image cut to what is shown, and its subpixels joined."""
    rows, columns = (np.flatnonzero(is_shown.any(axis)) for axis in (1, 0))
    pad = _MARGIN_PX * _SUBPIXELS
    image = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    more = [-size % _SUBPIXELS for size in image.shape[:2]]
    return _joined(np.pad(image, ((0, more[0]), (pad, pad + more[1]), (0, 0)), constant_values=1.0))


def _joined(image: np.ndarray) -> np.ndarray:
    """An image `(H, W, 3)` whose pixels are the means of an image's subpixels."""
    height, width = (size // _SUBPIXELS for size in image.shape[:2])
    return image.reshape(height, _SUBPIXELS, width, _SUBPIXELS, 3).mean((1, 3))


def _remoteness(depth: np.ndarray, body: np.ndarray) -> np.ndarray:
    """0 at the nearest depth of a body, 1 at the farthest."""
    body = body[body > 0]
    return np.clip((depth - body.min()) / max(float(np.ptp(body)), 1e-6), 0, 1)


def _viridis(depth: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Colours `(..., 3)` of depths, those of a body as in its picture; white where there is none."""
    from matplotlib import colormaps

    return np.where((depth > 0)[..., None], colormaps["viridis"](_remoteness(depth, body))[..., :3], 1.0)


def _centred(focal: float, width: int, height: int) -> Camera:
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _rotation(axis: int, angle: float) -> np.ndarray:
    """About one of the camera's axes."""
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation[first, first], rotation[second, second] = cos, cos
    rotation[first, second], rotation[second, first] = -sin, sin
    return rotation
