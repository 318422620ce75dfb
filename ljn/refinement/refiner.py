"""Pose, shape and place that agree with a depth image: damped Gauss-Newton, from a regressor's guess.

What is minimised over a change of the body (see `surface`) is the sum of

- the cloud: of each point, the squared distance to the tangent plane of the nearest vertex that faces the camera and
  agrees in its normal, and a little of the distance to the vertex itself. Both count by Geman and McClure's weights,
  (s^2 / (s^2 + d^2))^2, whose scale s falls from step to step, so foreign points lose their hold;
- the outline: of each vertex that is seen where the image shows none of the body, the squared distance to the nearest
  pixel that does, at the vertex's depth. It keeps hidden limbs behind the body;
- the guess: its change's Mahalanobis distance, with the covariance of the regressor's errors. Through it, what is seen
  of the body moves what is hidden, too.

The nearest vertex is looked for anew in each step among all vertices (a few hundred thousand pairs): the one in a
point's pixel is another limb's where the guess is a limb's width off.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from ljn.body import SMPL
from ljn.geometry.points import gather_points
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.refinement.prior import guess_precision
from ljn.refinement.surface import BodyState, BodySurface, PosedSurface

_TURN_M2 = 0.02  # of a normal's disagreement, 1 - cosine, beside a squared distance
_FACING = 0.1  # cosine between a normal and the ray, up to which a vertex may be seen
_EVERY = 4  # points of which one asks for its vertex itself, not for its plane alone
_OUTLINE_PX = 0.7  # from a vertex to the middle of a pixel of the body, up to which it counts as on it
_DAMPING = 1e-4  # of the normal equations' diagonal
_AT_ONCE = 8  # samples on a CPU, for its cache's sake
# A fit is given up that explains hardly anything, or little although it has gone far from its guess: as often as not it
# is the worse one. One that has not gone far may have foreign points before it.
_HOPELESS, _DOUBTFUL, _FAR_CHANGE = 0.7, 0.3, 200.0  # misfits; squared Mahalanobis distance
_FAR_M = 0.05  # points farther from the mesh count as unexplained
_TANGENT_M = 0.02  # radius of a vertex's share of the surface: within it, its plane stands for the mesh


@dataclass(frozen=True)
class RefinementSettings:
    """How a mesh is fitted.

    Attributes:
        num_steps: Gauss-Newton steps.
        num_points: Points of the cloud that are used; in all steps but the first and the last third, half of them.
        num_vertices: Vertices of the mesh that are used.
        num_outline: Vertices that the outline may move in a step: those farthest off.
        scales_m: Scale of the robust weights in the first step and in the last, metres, falling geometrically.
        cloud_weight: Weight of the mean over the points, 1/m^2: as of so many measurements with a standard deviation of
            1 m, or 375 of 5 mm.
        vertex_share: Of that, for the distance to the vertex itself.
        outline_share: Of that, for the mean over the vertices of the outline.
        outline_scale_m: Scale of the outline's robust weights, metres.
        prior_weight: Weight of the guess.
    """

    num_steps: int = 10
    num_points: int = 1024
    num_vertices: int = 1722
    num_outline: int = 96
    scales_m: tuple[float, float] = (0.1, 0.05)
    cloud_weight: float = 1.5e7
    vertex_share: float = 0.02
    outline_share: float = 0.3
    outline_scale_m: float = 0.05
    prior_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ("num_steps", "num_points", "num_vertices", "num_outline"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(
                    f"{name}: expected a whole number of at least 1, got {getattr(self, name)!r}"
                )
        for name in ("cloud_weight", "vertex_share", "outline_share", "prior_weight"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}: expected a number of 0 or more, got {getattr(self, name)!r}")
        if not all(0 < scale < np.inf for scale in (*self.scales_m, self.outline_scale_m)):
            raise ValueError("scales_m, outline_scale_m: expected positive numbers")


SETTINGS: Mapping[str, RefinementSettings] = {
    "accurate": RefinementSettings(),
    "fast": RefinementSettings(num_steps=3, num_points=640, num_outline=48),
}
"""The settings by name."""


class Refined(NamedTuple):
    """Fitted bodies: where `is_kept` is false, the guess as it came.

    Attributes:
        rotmats: `(B, 24, 3, 3)`, relative to the parent joint; the first leads from SMPL's rest frame into body world.
        betas: `(B, 10)`.
        root: `(B, 3)`, the root joint, metres, camera frame.
        is_kept: `(B,)` bool: the fit explains the cloud better than the guess does, and well enough.
        misfit: `(B,)`: what the cloud costs by Geman and McClure's function, of 0 to 1 for each point, of what is
            returned. Noise and the vertices' spacing alone make some 0.1.
        residual_mm: `(B, 2)`: median distance of the cloud's points to the mesh, of the guess and of what is returned.
        unexplained: `(B, 2)`: share of the points that are more than 5 cm from the mesh, of both.
    """

    rotmats: Tensor
    betas: Tensor
    root: Tensor
    is_kept: Tensor
    misfit: Tensor
    residual_mm: Tensor
    unexplained: Tensor


class Refiner(nn.Module):
    """Fits a body's pose, shape and place to a depth image, in batches, without gradients.

    Args:
        body: The body that is fitted, of one gender; on its device and in its precision.
        settings: How; or a name of `SETTINGS`.
        covariance: `(85, 85)`, of the guess's errors; None: as measured of the weights that ship. See `prior`.
    """

    precision: Tensor
    takes = ("points", "crop", "crop_camera")
    """What it takes of an observation."""

    def __init__(
        self,
        body: SMPL,
        settings: RefinementSettings | str = "accurate",
        covariance: np.ndarray | None = None,
    ) -> None:
        super().__init__()
        if isinstance(settings, str):
            settings = SETTINGS[chosen_settings(settings) or "accurate"]
        self.settings = settings
        self.surface = BodySurface(body, self.settings.num_vertices)
        dtype, device = body._v_template.dtype, body._v_template.device
        precision = guess_precision(body.hash, covariance).to(device, dtype)
        self.register_buffer("precision", precision, persistent=False)

    @torch.no_grad()
    def forward(
        self, observation: Mapping[str, Tensor], rotmats: Tensor, betas: Tensor, joints: Tensor
    ) -> Refined:
        """Fit bodies.

        Args:
            observation: `points` `(B, N, 6)`, `crop` `(B, P, P)` and `crop_camera` `(B, 4)`; see `Observation`.
            rotmats: `(B, 24, 3, 3)`, the guessed pose; see `Refined`.
            betas: `(B, 10)`, the guessed shape.
            joints: `(B, 24, 3)`, the joints as detected, metres, camera frame: the guess's place is where its joints
                lie nearest to them.

        Raises:
            ValueError: The guess or the joints are not finite.
        """
        if not all(bool(value.isfinite().all()) for value in (rotmats, betas, joints)):
            raise ValueError(
                "refine: NaN or infinite values in the guess; the networks' weights or input are broken"
            )
        dtype = self.precision.dtype
        with torch.autocast(rotmats.device.type, enabled=False):
            values = [observation[name] for name in self.takes]
            values = [value.to(dtype) for value in (*values, rotmats, betas, joints)]
            step = _AT_ONCE if rotmats.device.type == "cpu" else max(1, len(rotmats))
            parts = [self._fit(*part) for part in zip(*(value.split(step) for value in values))]
            return Refined(*(torch.cat(part) for part in zip(*parts)))

    def guess(self, rotmats: Tensor, betas: Tensor, joints: Tensor) -> BodyState:
        """The guess in the camera frame; arguments as in a call."""
        cam_from_body = CAMERA_FROM_BODY.to(rotmats)
        turned = torch.cat([cam_from_body @ rotmats[:, :1], rotmats[:, 1:]], 1)
        at_origin = self.surface(BodyState(turned, betas, torch.zeros_like(joints[:, 0]))).joints
        return BodyState(turned, betas, (joints - at_origin).mean(1))

    def _fit(
        self,
        points: Tensor,
        crop: Tensor,
        crop_camera: Tensor,
        rotmats: Tensor,
        betas: Tensor,
        joints: Tensor,
    ) -> Refined:
        settings = self.settings
        seen = _Seen(points[:, : settings.num_points], crop, crop_camera)
        state = guess = self.guess(rotmats, betas, joints)
        posed = self.surface(state)
        match = self._match(seen, posed)
        before = self._explained(match)
        first, last = settings.scales_m
        for step in range(settings.num_steps):
            scale = first * (last / first) ** (step / max(1, settings.num_steps - 1))
            state = state.moved(self._step(seen, posed, match, state.change_from(guess), scale))
            posed = self.surface(state)
            # Half of the points lead as near as the last steps need.
            is_rough = step + 1 < 2 * settings.num_steps // 3
            match = self._match(seen, posed, max(1, settings.num_points // 2) if is_rough else None)
        after = self._explained(match)

        moved = state.change_from(guess)
        is_far = (moved @ self.precision * moved).sum(-1) > _FAR_CHANGE
        is_given_up = (after.misfit > _HOPELESS) | is_far & (after.misfit > _DOUBTFUL)
        is_kept = (after.misfit < before.misfit) & ~is_given_up
        chosen = BodyState(
            *(
                torch.where(is_kept.view(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(state, guess)
            )
        )
        body_from_cam = CAMERA_FROM_BODY.to(rotmats).T
        turned = torch.cat([body_from_cam @ chosen.rotmats[:, :1], chosen.rotmats[:, 1:]], 1)
        both = [
            torch.stack([old, torch.where(is_kept, new, old)], 1)
            for old, new in ((before.residual_mm, after.residual_mm), (before.unexplained, after.unexplained))
        ]
        misfit = torch.where(is_kept, after.misfit, before.misfit)
        return Refined(turned, chosen.betas, chosen.root, is_kept, misfit, *both)

    def _match(self, seen: "_Seen", posed: PosedSurface, num_points: int | None = None) -> "_Match":
        """Match the first points of the cloud; None: all of them."""
        points, point_normals = seen.points[:, :num_points], seen.normals[:, :num_points]
        is_facing = (posed.normals * normalize(posed.vertices, dim=-1)).sum(-1) < _FACING
        index = nearest_vertices(points, point_normals, posed.vertices, posed.normals, is_facing)
        normals = gather_points(posed.normals, index)
        offsets = gather_points(posed.vertices, index) - points
        agreement = (point_normals * normals).sum(-1).clamp(min=0)
        return _Match(index, normals, offsets, (offsets * normals).sum(-1), agreement)

    def _step(
        self, seen: "_Seen", posed: PosedSurface, match: "_Match", moved: Tensor, scale_m: float
    ) -> Tensor:
        """The change `(B, 85)` of one step."""
        settings = self.settings
        index, directions, residuals = zip(
            *self._cloud(match, scale_m),
            *([self._outline(seen, posed)] if settings.outline_share else []),
        )
        rows = self.surface.rows(posed, torch.cat(index, 1), torch.cat(directions, 1))
        residual = torch.cat(residuals, 1)
        prior = settings.prior_weight * self.precision
        system = rows.mT @ rows + prior
        system = system + _DAMPING * torch.diag_embed(system.diagonal(dim1=-2, dim2=-1))
        gradient = (residual[:, None] @ rows).squeeze(1) + moved @ prior
        factor = torch.linalg.cholesky_ex(system).L
        change = -torch.cholesky_solve(gradient[..., None], factor).squeeze(-1)
        # Where a system cannot be solved the body stays.
        return change.where(change.isfinite().all(-1, keepdim=True), 0.0)

    def _cloud(self, match: "_Match", scale_m: float) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Vertices, directions and residuals of the cloud's terms, weighted."""
        settings = self.settings
        weight = robust_weight(match.offsets.square().sum(-1), scale_m) * match.agreement
        weight = (settings.cloud_weight * weight / weight.shape[1]).sqrt()
        terms = [(match.nearest, match.normals * weight[..., None], match.to_plane * weight)]
        if settings.vertex_share:
            index, offsets = match.nearest[:, ::_EVERY], match.offsets[:, ::_EVERY]
            weight = weight[:, ::_EVERY] * (_EVERY * settings.vertex_share) ** 0.5
            axes = torch.eye(3, dtype=offsets.dtype, device=offsets.device)
            terms += [(index, (weight[..., None] * axes[i]), weight * offsets[..., i]) for i in range(3)]
        return terms

    def _outline(self, seen: "_Seen", posed: PosedSurface) -> tuple[Tensor, Tensor, Tensor]:
        """Vertices, directions and residuals of the outline, weighted: those farthest off."""
        settings = self.settings
        x, y, depth = posed.vertices.unbind(-1)
        fx, fy, cx, cy = seen.camera[:, None].unbind(-1)
        size = seen.size
        depth = depth.clamp(min=0.1)
        column, row = x / depth * fx + cx, y / depth * fy + cy
        pixel = row.round().clamp(0, size - 1) * size + column.round().clamp(0, size - 1)
        nearest = seen.nearest.gather(1, pixel.long())
        across, down = column - nearest % size, row - torch.div(nearest, size, rounding_mode="floor")
        distance_px = torch.hypot(across, down)
        outside = (distance_px - _OUTLINE_PX).clamp(min=0) / distance_px.clamp(min=1e-6)
        across, down = across * outside * depth / fx, down * outside * depth / fy  # metres
        squared = across.square() + down.square()
        weight = robust_weight(squared, settings.outline_scale_m)
        count = min(settings.num_outline, squared.shape[1])
        index = (weight * squared).topk(count, -1).indices
        weight = settings.cloud_weight * settings.outline_share * weight.gather(1, index) / squared.shape[1]
        weight = weight.sqrt()
        vertices = gather_points(posed.vertices, index)
        rays = vertices[..., :2] / vertices[..., 2:].clamp(min=0.1)
        zero = torch.zeros_like(weight)
        # Of x / z at a fixed scale z: dx - (x / z) dz.
        directions = torch.cat(
            [
                torch.stack([weight, zero, -rays[..., 0] * weight], -1),
                torch.stack([zero, weight, -rays[..., 1] * weight], -1),
            ],
            1,
        )
        residuals = torch.cat([weight * across.gather(1, index), weight * down.gather(1, index)], 1)
        return torch.cat([index, index], 1), directions, residuals

    def _explained(self, match: "_Match") -> "_Explained":
        squared = match.offsets.square().sum(-1)
        scale = self.settings.scales_m[1]
        # Geman and McClure's own function, 0 to 1, whose weights those of the steps are.
        disagrees = 1 - match.agreement / (1 + squared / scale**2)
        beside = (squared - match.to_plane.square()).clamp(min=0).sqrt()
        distance = torch.hypot(match.to_plane, (beside - _TANGENT_M).clamp(min=0))
        return _Explained(
            disagrees.mean(-1), 1000 * distance.median(-1).values, (distance > _FAR_M).to(squared).mean(-1)
        )


class _Seen:
    """What the fit is made to: points, normals, and for each pixel of the crop the nearest of the body."""

    def __init__(self, points: Tensor, crop: Tensor, camera: Tensor) -> None:
        self.points, self.normals = points.split(3, -1)
        self.camera = camera
        self.size = crop.shape[-1]
        self.nearest = nearest_pixels(crop > 0).flatten(1)


class _Match(NamedTuple):
    """Of each point of the cloud: its vertex, that one's normal, the way to it, the plane's distance, the agreement."""

    nearest: Tensor
    normals: Tensor
    offsets: Tensor
    to_plane: Tensor
    agreement: Tensor


class _Explained(NamedTuple):
    misfit: Tensor
    residual_mm: Tensor
    unexplained: Tensor


def chosen_settings(refine: bool | str | None) -> str | None:
    """The name in `SETTINGS` that is meant: true is "accurate"; None for null or false, no refinement.

    Raises:
        ValueError: There are no such settings.
    """
    if refine is None or refine is False:
        return None
    name = "accurate" if refine is True else refine
    if name not in SETTINGS:
        raise ValueError(f"refine: expected true, false, {' or '.join(SETTINGS)}, got {refine!r}")
    return name


def robust_weight(squared: Tensor, scale: float) -> Tensor:
    """Geman and McClure's weight of squared distances: 1 at none, a quarter at the scale, 0 far away."""
    return (scale**2 / (scale**2 + squared)).square()


def nearest_vertices(
    points: Tensor, normals: Tensor, vertices: Tensor, vertex_normals: Tensor, is_facing: Tensor
) -> Tensor:
    """Of each point the nearest vertex that faces the camera, `(B, N)` long; 0 where none does.

    Nearest is where the squared distance plus 0.02 m^2 times 1 - the cosine between the normals is least.

    Args:
        points: `(B, N, 3)`, metres.
        normals: `(B, N, 3)`, unit.
        vertices: `(B, U, 3)`, metres.
        vertex_normals: `(B, U, 3)`, unit.
        is_facing: `(B, U)` bool.
    """
    # |p - v|^2 less |p|^2, which is the same for all vertices, as one product.
    asked = torch.cat([points, normals, torch.ones_like(points[..., :1])], -1)
    squared = vertices.square().sum(-1, keepdim=True)
    offered = torch.cat([-2 * vertices, -_TURN_M2 * vertex_normals, squared], -1)
    if points.device.type != "cpu":
        costs = (asked @ offered.mT).masked_fill(~is_facing[:, None], torch.inf)
        return costs.argmin(-1)
    from ljn.refinement import kernels  # numba takes its time to import

    index = torch.empty(points.shape[:2], dtype=torch.int64)
    kernels.nearest_vertices(asked.numpy(), offered.numpy(), is_facing.numpy(), index.numpy())
    return index


def nearest_pixels(is_body: Tensor) -> Tensor:
    """Of each pixel the nearest of the body, `(B, P, P)` long: row * P + column; of masks `(B, P, P)` bool."""
    from ljn.refinement import kernels  # numba takes its time to import

    masks = is_body.cpu()
    index = torch.empty(masks.shape, dtype=torch.int64)
    kernels.nearest_pixels(masks.contiguous().numpy(), index.numpy())
    return index.clamp(min=0).to(is_body.device)
