"""A page of pictures of the embedded bodies: shapes, poses and part labels, drawn without a display."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ljn.body.build.measures import posed
from ljn.body.build.poses import ARMS_DOWN, EXTREME_POSES, pose_vector
from ljn.body.files import NUM_BETAS, BodyModel
from ljn.body.parts import PART_NAMES, face_parts
from ljn.drawing import new_figure
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotation_about
from ljn.render.shading import SKIN, shade_mesh

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_DISTANCE = 40.0
"""Metres to the camera: far enough for an almost parallel projection."""
_SUPERSAMPLING = 2
_VIEWS = {"front": 0.0, "side": -90.0, "back": 180.0, "oblique": -40.0}
"""How far, in degrees about the vertical, the body is turned before it is drawn."""


def draw_body(
    vertices: Array,
    faces: NDArray[np.int64],
    view: str = "front",
    scale: float = 100.0,
    width: float = 2.0,
    height: float = 2.0,
    centre: tuple[float, float, float] | None = None,
    colours: Array | None = None,
) -> Image:
    """A shaded picture of one mesh on white, `(height * scale, width * scale, 3)` RGB, from a key of `_VIEWS`.

    `vertices` are `(V, 3)`, metres, SMPL's rest frame (y up, z forward); `scale` is in pixels a metre, width, height
    and `centre` in metres, the middle of the picture, by default that of the mesh. `colours` are `(F, 3)` RGB in 0-1;
    None for skin.
    """
    turn = rotation_about("y", torch.tensor(np.radians(_VIEWS[view]), dtype=torch.float64)).numpy()
    middle = (vertices.min(0) + vertices.max(0)) / 2 if centre is None else np.array(centre)
    seen = (vertices - middle) @ turn.T * [1.0, -1.0, -1.0] + [0.0, 0.0, _DISTANCE]
    fine = scale * _SUPERSAMPLING
    columns, rows = round(width * fine), round(height * fine)
    camera = Camera(_DISTANCE * fine, _DISTANCE * fine, (columns - 1) / 2, (rows - 1) / 2, columns, rows)
    image = shade_mesh(seen, faces, camera, SKIN if colours is None else colours)
    image = image.reshape(rows // _SUPERSAMPLING, _SUPERSAMPLING, -1, _SUPERSAMPLING, 3).mean((1, 3))
    return np.round(255 * image).astype(np.uint8)


def draw_page(models: list[BodyModel], path: Path, seed: int = 2) -> None:
    """Writes a page of pictures: each body's T-pose, random and extreme shapes; poses and parts of the neutral one."""
    rows: list[tuple[str, Image]] = []
    rng = np.random.default_rng(seed)
    standing = pose_vector(ARMS_DOWN)
    for model in models:
        template = model.v_template.astype(np.float64)
        tposes = [draw_body(template, model.faces, view, width=1.9) for view in ("front", "back")]
        tposes += [draw_body(template, model.faces, "side", width=0.7)]
        draws = [
            draw_body(posed(model, standing, rng.normal(size=NUM_BETAS)), model.faces, view, width=0.95)
            for view in ("front", "oblique") * 6
        ]
        rows.append((f"{model.gender}: T-pose; random draws of beta", np.concatenate(tposes + draws, 1)))
        extremes = [
            draw_body(posed(model, standing, sign * 2 * unit), model.faces, view, width=0.79)
            for unit in np.eye(NUM_BETAS)
            for sign, view in ((-1, "oblique"), (1, "oblique"))
        ]
        rows.append((f"{model.gender}: each beta at -2 and +2", np.concatenate(extremes, 1)))
    model = next((model for model in models if model.gender == "neutral"), models[0])
    for view in ("front", "side", "back"):
        bodies = [posed(model, pose_vector(angles)) for angles in EXTREME_POSES.values()]
        pictures = [draw_body(body, model.faces, view, width=1.25, height=2.3) for body in bodies]
        rows.append((f"{model.gender}, {view}: {' | '.join(EXTREME_POSES)}", np.concatenate(pictures, 1)))
    rows.append((f"parts: {', '.join(PART_NAMES)}", _draw_parts(model)))
    _write(rows, path)


def _part_colours() -> Array:
    """`(P, 3)` RGB in 0..1, one for each name of a part."""
    from matplotlib import colormaps

    return np.asarray(colormaps["tab20"](np.arange(len(PART_NAMES)) % 20))[:, :3]


def _draw_parts(model: BodyModel) -> Image:
    colours = _part_colours()[face_parts(model)]
    template = model.v_template.astype(np.float64)
    squat = posed(model, pose_vector(EXTREME_POSES["squat"]))
    shown = [(template, view, 2.0) for view in ("front", "back")] + [(squat, view, 1.2) for view in _VIEWS]
    pictures = [
        draw_body(body, model.faces, view, width=width, colours=colours) for body, view, width in shown
    ]
    return np.concatenate(pictures, axis=1)


def _write(rows: list[tuple[str, Image]], path: Path) -> None:
    """Stacks pictures under their titles, at the pictures' own resolution."""
    import PIL.Image
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    margin, width = 18, max(image.shape[1] for _, image in rows)
    height = sum(image.shape[0] + margin for _, image in rows)
    page = np.full((height, width, 3), 255, np.uint8)
    figure = new_figure(width / 100, height / 100)
    figure.set_layout_engine("none")
    top = 0
    for title, image in rows:
        figure.text(4 / width, 1 - (top + 2) / height, title, fontsize=8, va="top")
        page[top + margin :][: image.shape[0], : image.shape[1]] = image
        top += image.shape[0] + margin
    figure.figimage(page, zorder=-1)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = PIL.Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    # Colours from a palette make the file a third as large.
    skin = np.linspace(0, 1, 40)[:, None] * np.array(SKIN)
    ramps = [skin, np.linspace(1, SKIN, 10), np.linspace(0, [1, 1, 1], 8)]
    ramps += [np.linspace(0.2, 1, 11)[:, None] * colour for colour in _part_colours()]
    palette = PIL.Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * np.concatenate(ramps)).astype(np.uint8).tobytes())
    picture.quantize(palette=palette, dither=PIL.Image.Dither.NONE).save(path, optimize=True)
