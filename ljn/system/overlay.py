"""The mesh drawn over the image (Eq. 4.1), with the 2D joints."""

import numpy as np

from ljn.body.skeleton import BONES
from ljn.geometry.camera import Camera
from ljn.pipeline.pictures import MESH, NEAREST_M
from ljn.render.shading import shade_mesh
from ljn.system.system import ArResult

_OPACITY = 0.65
_SURE, _UNSURE, _BAD = (255, 214, 64), (150, 150, 150), (235, 70, 60)
_TEXT = (255, 255, 255)


def draw_overlay(result: ArResult, camera: Camera) -> np.ndarray:
    """A frame's picture `(H, W, 3)` uint8: its colours, or else its depth in grey, the mesh and the 2D joints over it.

    What could not be predicted is framed in red, with the reason below.
    """
    import cv2  # takes a tenth of a second

    picture = _background(result, camera)
    prediction = result.prediction
    if prediction is not None:
        vertices, faces = prediction.vertices, prediction.faces
        if vertices is not None and faces is not None and vertices[:, 2].min() > NEAREST_M:
            mesh = shade_mesh(vertices, faces, camera, MESH, background=np.nan)
            is_mesh = np.isfinite(mesh[..., 0])
            drawn = _OPACITY * 255 * mesh[is_mesh] + (1 - _OPACITY) * picture[is_mesh]
            picture[is_mesh] = drawn.clip(0, 255).astype(np.uint8)
        if prediction.keypoints is not None and prediction.confidences is not None:
            places = [tuple(map(int, place)) for place in np.rint(prediction.keypoints)]
            is_sure = prediction.confidences > 0
            for parent, joint in BONES:
                if is_sure[parent] and is_sure[joint]:
                    cv2.line(picture, places[parent], places[joint], _SURE, 1, cv2.LINE_AA)
            for place, sure in zip(places, is_sure):
                cv2.circle(picture, place, 2, _SURE if sure else _UNSURE, -1, cv2.LINE_AA)
    caption = result.frame.name + (f"  sides {result.flip}" if result.flip else "")
    if result.error is not None:
        picture[:4] = picture[-4:] = picture[:, :4] = picture[:, -4:] = _BAD
        caption = f"{result.frame.name}: {result.error}"
    _write(picture, caption)
    return picture


def _background(result: ArResult, camera: Camera) -> np.ndarray:
    frame = result.frame
    if frame.rgb is not None:
        return frame.rgb.copy()
    if frame.depth is None or not (frame.depth > 0).any():
        return np.zeros((camera.height, camera.width, 3), np.uint8)
    seen = frame.depth > 0
    near, far = np.percentile(frame.depth[seen], [1, 99])
    grey = np.where(seen, 230 - 180 * ((frame.depth - near) / max(far - near, 1e-6)).clip(0, 1), 0)
    return np.repeat(grey[..., None], 3, -1).astype(np.uint8)


def _write(picture: np.ndarray, text: str) -> None:
    """Text at the lower edge, as much of it as there is room for."""
    import cv2

    plain = text.encode("ascii", "replace").decode()[: max(1, picture.shape[1] // 7)]
    for colour, width in (((0, 0, 0), 3), (_TEXT, 1)):
        cv2.putText(
            picture,
            plain,
            (8, picture.shape[0] - 8),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.38,
            colour,
            width,
            cv2.LINE_AA,
        )
