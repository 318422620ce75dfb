"""A batched rasteriser in plain torch operations: runs wherever the vertices are, with the z-buffer's coverage."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from ljn.geometry.camera import Camera
from ljn.render import Fragments, Renderer, check_vertices


class TorchRasterizer(Renderer):
    """The `torch` backend of `ljn.render.Renderer`.

    Runs and returns on the vertices' device; computes in float64 if the vertices are float64, else in float32.
    In float64 it does the z-buffer's arithmetic, operation by operation. No gradients.

    Every pixel of a triangle's box is a candidate, tested against the triangle's edges; the candidates of all
    triangles of all meshes lie side by side. The images are the same whatever `max_candidates` is.

    Args:
        max_candidates: Candidates that are tested at a time, and triangles that are prepared at a time; a body
            of 13,776 faces has about 40,000 candidates at 3 m and 180,000 at 1.5 m. The working memory is some
            250 bytes for each in float32 and 400 in float64, beside the images. It is exceeded only where a
            single mesh has more triangles, or a single triangle more pixels.
    """

    def __init__(self, max_candidates: int = 2**20) -> None:
        if max_candidates < 1:
            raise ValueError(f"max_candidates: expected at least 1, got {max_candidates}")
        self.max_candidates = max_candidates

    @torch.no_grad()
    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """See `ljn.render.Renderer`."""
        corners, faces = _prepare(vertices, faces, camera)
        inverse = self._inverse_depth(corners, faces, camera)
        return _depth(inverse, camera)

    @torch.no_grad()
    def fragments(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """See `ljn.render.Renderer`; of faces that are equally near, the first is seen."""
        corners, faces = _prepare(vertices, faces, camera)
        inverse = self._inverse_depth(corners, faces, camera)
        # A second pass: a single one would leave ties to the order in which a GPU's threads come.
        no_face = max(len(faces), 1)
        face_ids = torch.full(inverse.shape, no_face, device=inverse.device)
        for hits in self._hits(corners, faces, camera):
            is_nearest = hits.inverse == inverse.index_select(0, hits.pixel)
            candidates = torch.where(is_nearest, hits.triangle % no_face, no_face)
            face_ids.scatter_reduce_(0, hits.pixel, candidates, "amin")
        face_ids.masked_fill_(face_ids == no_face, -1)
        barycentrics = _barycentrics(corners, faces, face_ids, camera)
        return Fragments(
            _depth(inverse, camera),
            face_ids.view(-1, camera.height, camera.width),
            barycentrics.view(-1, camera.height, camera.width, 3),
        )

    def _inverse_depth(self, corners: "_Projected", faces: Tensor, camera: Camera) -> Tensor:
        """`(B * H * W,)`: inverse depth of the nearest surface, 0 in the background."""
        size = len(corners.u) * camera.height * camera.width
        inverse = torch.zeros(size, dtype=corners.u.dtype, device=corners.u.device)
        for hits in self._hits(corners, faces, camera):
            inverse.scatter_reduce_(0, hits.pixel, hits.inverse, "amax")
        return inverse

    def _hits(self, corners: "_Projected", faces: Tensor, camera: Camera) -> Iterator["_Hits"]:
        """All pairs of a pixel and a triangle that covers it, in portions."""
        if faces.numel() == 0:
            return
        num_meshes = max(1, self.max_candidates // len(faces))
        for first in range(0, len(corners.u), num_meshes):
            part = _Projected(*(values[first : first + num_meshes] for values in corners))
            for hits in _covered(part, faces, camera, self.max_candidates):
                hits.pixel.add_(first * camera.height * camera.width)
                hits.triangle.add_(first * len(faces))
                yield hits


class _Projected(NamedTuple):
    """Vertices in the image, each `(B, V)`: u and v in pixels, inverse depth in 1/metres."""

    u: Tensor
    v: Tensor
    inverse: Tensor


class _Hits(NamedTuple):
    """Pairs of a pixel and a triangle that covers it, each `(S,)`.

    The pixel is numbered `(mesh * H + row) * W + column`, the triangle `mesh * F + face`; the inverse depth of
    the triangle there is 0 where it is too thin to have one.
    """

    pixel: Tensor
    triangle: Tensor
    inverse: Tensor


def _prepare(vertices: Tensor, faces: Tensor, camera: Camera) -> tuple[_Projected, Tensor]:
    """The vertices in the image; the faces `(F, 3)` as int64 on their device."""
    check_vertices(vertices)
    dtype = torch.float64 if vertices.dtype == torch.float64 else torch.float32
    x, y, z = vertices.detach().to(dtype).unbind(-1)
    inverse = 1.0 / z
    u, v = x * inverse * camera.fx + camera.cx, y * inverse * camera.fy + camera.cy
    return _Projected(u, v, inverse), faces.to(vertices.device, torch.int64)


def _depth(inverse: Tensor, camera: Camera) -> Tensor:
    """Depth `(B, H, W)` float32 from inverse depth `(B * H * W,)`, which is overwritten."""
    depth = inverse.reciprocal_().nan_to_num_(posinf=0.0)
    return depth.float().view(-1, camera.height, camera.width)


def _edge_functions(du: list[Tensor], dv: list[Tensor]) -> list[Tensor]:
    """The edge functions opposite to corners a, b and c at a pixel, from the corners' offsets to it.

    Each comes from the two ends of its edge alone, as the difference of two rounded products: neighbours get it
    with the opposite sign to the last bit, so that no pixel falls through a shared edge. Fused multiply-adds
    (addcmul, a compiler) would break that.
    """
    return [(du[i] * dv[j]).sub_(du[j] * dv[i]) for i, j in ((1, 2), (2, 0), (0, 1))]


def _covered(corners: _Projected, faces: Tensor, camera: Camera, max_candidates: int) -> Iterator[_Hits]:
    """The hits of a few meshes, whose T triangles are prepared at once.

    Two ragged expansions, of triangles to the R rows of their boxes and of rows to their C pixels; S of these are
    covered.
    """
    num_meshes, num_faces = len(corners.u), len(faces)
    device, dtype = corners.u.device, corners.u.dtype
    # index_select throughout: on a CPU it is several times faster than indexing.
    us, vs, inverses = ([x.index_select(1, k).view(-1) for k in faces.T.contiguous()] for x in corners)
    left, num_columns = _pixel_range(us, camera.width)
    top, num_rows = _pixel_range(vs, camera.height)
    area = (us[1] - us[0]).mul_(vs[2] - vs[0]).sub_((us[2] - us[0]).mul_(vs[1] - vs[0]))
    num_rows *= (num_columns > 0) & (area.abs() > 0)
    sign = area.sign_()
    row_end = num_rows.cumsum(0)
    top += num_rows - row_end  # (T,); add the number of a row among all of them for its v
    image_top = (torch.arange(num_meshes, device=device) * camera.height).repeat_interleave(num_faces)

    for portion in _portions(row_end, (num_rows * num_columns).cumsum(0), max_candidates):
        of_row = torch.repeat_interleave(
            num_rows[portion.start : portion.stop], output_size=portion.num_rows
        ).add_(portion.start)  # (R,)
        row = torch.arange(portion.first_row, portion.first_row + portion.num_rows, device=device)
        row += top.index_select(0, of_row)
        row_sign, row_v = sign.index_select(0, of_row), row.to(dtype)
        row_us = [u.index_select(0, of_row) for u in us]
        # The sign turns triangles that are seen from behind: all three edge functions change theirs, exactly.
        row_dvs = [v.index_select(0, of_row).sub_(row_v).mul_(row_sign) for v in vs]
        length = num_columns.index_select(0, of_row)
        # (R,); add the number of a candidate for its u.
        row_left = left.index_select(0, of_row).add_(length).sub_(length.cumsum(0))

        of_candidate = torch.repeat_interleave(length, output_size=portion.num_candidates)  # (C,)
        column = torch.arange(portion.num_candidates, device=device)
        u = row_left.index_select(0, of_candidate).add_(column).to(dtype)
        edges = _edge_functions(
            [x.index_select(0, of_candidate).sub_(u) for x in row_us],
            [x.index_select(0, of_candidate) for x in row_dvs],
        )
        is_inside = torch.minimum(torch.minimum(edges[0], edges[1]), edges[2]) >= 0

        hit = is_inside.nonzero().squeeze(1)  # (S,)
        hit_row = of_candidate.index_select(0, hit)
        triangle = of_row.index_select(0, hit_row)
        row_start = row.add_(image_top.index_select(0, of_row)).mul_(camera.width).add_(row_left)
        pixel = row_start.index_select(0, hit_row).add_(hit)
        a, b, c = (edge.index_select(0, hit) for edge in edges)
        wa, wb, wc = (w.index_select(0, triangle) for w in inverses)
        total = a + b + c
        inverse = a.mul_(wa).add_(b.mul_(wb)).add_(c.mul_(wc)).div_(total)
        # A sliver thinner than rounding: its neighbours have this pixel.
        yield _Hits(pixel, triangle, inverse.masked_fill_(total == 0, 0.0))


def _pixel_range(corners: list[Tensor], size: int) -> tuple[Tensor, Tensor]:
    """The first pixel centre in the image between three coordinates, and how many there are; each `(T,)` int64."""
    low = torch.minimum(torch.minimum(corners[0], corners[1]), corners[2])
    high = torch.maximum(torch.maximum(corners[0], corners[1]), corners[2])
    first = low.ceil_().clamp_(0, size)
    number = high.floor_().clamp_(-1, size - 1).sub_(first).add_(1).clamp_(min=0)
    return first.long(), number.long()


class _Portion(NamedTuple):
    """Triangles `start` to `stop`, the number of their first row, how many rows and candidates they have."""

    start: int
    stop: int
    first_row: int
    num_rows: int
    num_candidates: int


def _portions(row_end: Tensor, candidate_end: Tensor, max_candidates: int) -> Iterator[_Portion]:
    """Cut triangles into portions of about `max_candidates`; the arguments are cumulative sums `(T,)`."""
    total = int(candidate_end[-1])
    targets = (
        torch.arange(1, max(1, -(-total // max_candidates)), device=candidate_end.device) * max_candidates
    )
    zero = candidate_end.new_zeros(1)
    last = torch.full_like(zero, len(candidate_end))
    cuts = torch.cat([zero, torch.searchsorted(candidate_end, targets, right=True), last])
    # One transfer from the device for all sizes: nothing below has to wait for it again.
    cuts_and_sums = [
        cuts,
        *(torch.cat([zero, end]).index_select(0, cuts) for end in (row_end, candidate_end)),
    ]
    table = torch.stack(cuts_and_sums, 1).tolist()
    for (start, row, candidate), (stop, next_row, next_candidate) in pairwise(table):
        if next_candidate > candidate:
            yield _Portion(start, stop, row, next_row - row, next_candidate - candidate)


def _barycentrics(corners: _Projected, faces: Tensor, face_ids: Tensor, camera: Camera) -> Tensor:
    """Weights `(B * H * W, 3)` float32 of the corners of the faces `(B * H * W,)` that are seen; -1 is background."""
    pixel = (face_ids >= 0).nonzero().squeeze(1)  # (S,)
    mesh = pixel // (camera.height * camera.width)
    row, column = pixel // camera.width % camera.height, pixel % camera.width
    seen = faces.index_select(0, face_ids.index_select(0, pixel)) + (mesh * corners.u.shape[1])[:, None]
    us, vs, inverses = ([x.flatten().index_select(0, k) for k in seen.unbind(1)] for x in corners)
    edges = _edge_functions([u - column for u in us], [v - row for v in vs])
    weights = torch.stack([edge.mul_(w) for edge, w in zip(edges, inverses)], 1)
    weights /= weights.sum(1, keepdim=True)
    barycentrics = torch.zeros(len(face_ids), 3, device=face_ids.device)
    return barycentrics.index_copy_(0, pixel, weights.float())
