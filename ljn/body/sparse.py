"""The SMPL layer for many bodies and no gradients, where most of a pose's offsets are zero."""

import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ljn.body.files import BodyModel
from ljn.body.smpl import SMPL

_LARGEST_SHARE = 0.25  # of nonzero numbers; beyond it the dense product is as fast


class SparseSMPL(SMPL):
    """The SMPL layer, to rounding, from the nonzero numbers of a body's offsets alone: without gradients, on a CPU.

    A joint of the embedded bodies moves the vertices around it only: nine of ten numbers are zero, and the product with
    the others takes an eighth of the time. Elsewhere, and of a body that has few zeros, it is the layer itself.
    """

    def __init__(self, models: BodyModel | Sequence[BodyModel]) -> None:
        super().__init__(models)
        self._sparse: dict[int, Tensor | None] = {}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "SparseSMPL":
        self._sparse = {}  # of another precision or device
        return super()._apply(fn, recurse)

    def on_vertices(self, vertices: Tensor) -> SMPL:
        """See `SMPL.on_vertices`."""
        layer = super().on_vertices(vertices)
        layer._sparse = {}  # type: ignore[assignment]
        return layer

    def _unposed(self, slot: int, features: Tensor) -> Tensor:
        directions = None if torch.is_grad_enabled() else self._sparse_directions(slot)
        if directions is None:
            return super()._unposed(slot, features)
        return self._v_template[slot] + (directions @ features.T).T

    def _sparse_directions(self, slot: int) -> Tensor | None:
        """The offsets of a body's coordinates `(3V, 217)`, compressed; None where that would not help."""
        if slot not in self._sparse:
            self._sparse[slot] = _compressed(self._directions[slot].T)
        return self._sparse[slot]


def _compressed(matrix: Tensor) -> Tensor | None:
    """A matrix in compressed rows; None where products with it would not be faster, or not possible."""
    is_sparse = matrix.count_nonzero() <= _LARGEST_SHARE * matrix.numel()
    if matrix.device.type != "cpu" or not torch.backends.mkl.is_available() or not is_sparse:
        return None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")
        compressed = matrix.to_sparse_csr()
        rows, columns = compressed.crow_indices().int(), compressed.col_indices().int()
        values, shape = compressed.values(), tuple(matrix.shape)
        return torch.sparse_csr_tensor(rows, columns, values, shape, check_invariants=False)
