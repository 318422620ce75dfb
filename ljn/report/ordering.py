"""Does the thesis's ordering hold? Comparisons of rows, over seeds and over test samples."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ljn.report.tables import ROOT_ALIGNED, Column
from ljn.runs.sweep import Run

NUM_RESAMPLES = 1000
_SEED = 0


@dataclass(frozen=True)
class Cell:
    """A number of a table, in its column's unit."""

    column: Column
    label: str  # of its row
    runs: tuple[Run, ...]  # whose result it is, one for each seed
    metric: str | None  # the metric that is shown; None where the row has no such value
    mean: float | None  # over seeds; None without a result
    sd: float | None  # standard deviation over seeds (one degree of freedom less); None of fewer than two
    num_seeds: int
    thesis: float | None

    @property
    def is_substituted(self) -> bool:
        """Whether it is of joints whose roots were moved to the same place, unlike the column's metric."""
        return self.metric != self.column.metric and self.metric in ROOT_ALIGNED.values()

    @property
    def difference(self) -> float | None:
        """Ours less the thesis's."""
        return None if self.mean is None or self.thesis is None else self.mean - self.thesis


@dataclass(frozen=True)
class Comparison:
    """Two rows in one column."""

    column: Column
    better: str  # label of the row that the thesis's numbers, or else ours, put first
    worse: str  # label of the other one
    is_claim: bool  # whether it is the thesis that puts it first
    is_adjacent: bool  # whether no row of the thesis lies between the two
    lead: float  # how much better `better` is in our runs, in the column's unit; negative where it is worse
    spread: float | None  # standard deviation of the lead over seeds; None where a row has fewer than two
    # 95 % interval of the lead over test samples, by a paired bootstrap; None where its values of the same samples are
    # not known for both
    interval: tuple[float, float] | None

    @property
    def holds(self) -> bool:
        """Whether our runs agree."""
        return self.lead > 0

    @property
    def exceeds_spread(self) -> bool | None:
        """Whether the absolute lead is larger than its spread over seeds; None with single seeds."""
        return None if self.spread is None else abs(self.lead) > self.spread


def compare(columns: Sequence[Sequence[Cell]]) -> tuple[Comparison, ...]:
    """The comparisons of a table, from its columns' cells; columns without a goal are not compared.

    Where the thesis has numbers, all pairs of rows that it puts in an order and that have results; where it has none
    for any row of the table, our best row and each other one.
    """
    is_claim = any(cell.thesis is not None for cells in columns for cell in cells)
    comparisons: list[Comparison] = []
    has_main = False
    for cells in columns:
        if not cells or (goal := cells[0].column.goal) is None:
            continue
        sign = -1 if goal == "max" else 1
        for better, worse, is_adjacent in _claims(cells, sign) if is_claim else _best_and_others(cells, sign):
            if better.mean is None or worse.mean is None:
                continue
            lead = sign * (worse.mean - better.mean)
            spread = None if better.sd is None or worse.sd is None else math.hypot(better.sd, worse.sd)
            interval = None if has_main else _interval(better, worse, sign)
            names = (better.column, better.label, worse.label)
            comparisons.append(Comparison(*names, is_claim, is_adjacent, lead, spread, interval))
        has_main = True
    return tuple(comparisons)


def count_claims(cells: Sequence[Cell]) -> int:
    """How many pairs of rows the thesis puts in an order in a column, with results or without."""
    return len(list(_claims(cells, 1))) if cells and cells[0].column.goal else 0


def verdict(comparisons: Sequence[Comparison], num_claims: int) -> tuple[bool | None, str]:
    """Whether the thesis's ordering holds in one or more columns, in words too.

    None, not True, where nothing speaks against it but rows are without a result.
    """
    claims = [comparison for comparison in comparisons if comparison.is_claim]
    if not claims:
        return None, "not judged: no two rows have both a result and a number of the thesis"
    number = f"{len(claims)} comparisons" if len(claims) > 1 else "the one comparison"
    missing = num_claims - len(claims)
    without = f"; {missing} more want a result" if missing else ""
    failing = sum(not comparison.holds for comparison in claims)
    if failing:
        return False, f"does not hold in {failing} of {number}{without}"
    return None if missing else True, f"holds in {'all ' if len(claims) > 1 else ''}{number}{without}"


def paired_bootstrap(
    better: np.ndarray, worse: np.ndarray, num_resamples: int = NUM_RESAMPLES, seed: int = _SEED
) -> tuple[float, float]:
    """The 95 % interval (ends, in the metric's unit) of the mean of `worse - better` over test samples.

    Both are `(S,)`, of the same samples, which are drawn anew `num_resamples` times, with replacement.
    """
    differences = np.asarray(worse, np.float64) - np.asarray(better, np.float64)
    generator = np.random.default_rng(seed)
    size = len(differences)
    means = [differences[generator.integers(size, size=size)].mean() for _ in range(num_resamples)]
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _claims(cells: Sequence[Cell], sign: int) -> Iterator[tuple[Cell, Cell, bool]]:
    """Pairs that the thesis puts in an order, the better one first, and whether none lies between them."""
    ranks = {id(cell): sign * cell.thesis for cell in cells if cell.thesis is not None}
    levels = sorted(set(ranks.values()))
    ranked = sorted((cell for cell in cells if id(cell) in ranks), key=lambda cell: ranks[id(cell)])
    for better, worse in combinations(ranked, 2):
        first, second = (levels.index(ranks[id(cell)]) for cell in (better, worse))
        if first != second:
            yield better, worse, second - first == 1


def _best_and_others(cells: Sequence[Cell], sign: int) -> Iterator[tuple[Cell, Cell, bool]]:
    known = [cell for cell in cells if cell.mean is not None and math.isfinite(cell.mean)]
    best = min(known, key=lambda cell: sign * (cell.mean or 0.0), default=None)
    for cell in known:
        if best is not None and cell is not best:
            yield best, cell, False


def _interval(better: Cell, worse: Cell, sign: int) -> tuple[float, float] | None:
    first, second = _mean_values(better), _mean_values(worse)
    if first is None or second is None or not len(first[0]) or not _are_same(first[0], second[0]):
        return None
    return paired_bootstrap(sign * first[1], sign * second[1])


def _mean_values(cell: Cell) -> tuple[np.ndarray, np.ndarray] | None:
    """A row's samples and their values, each sample's mean over the runs; see `Run.sample_values`."""
    complete = [run for run in cell.runs if run.status == "complete"]
    values = [run.sample_values(cell.metric) for run in complete] if cell.metric else []
    known = [entry for entry in values if entry is not None]
    if not known or len(known) < len(values):
        return None
    samples = known[0][0]
    if any(not _are_same(other, samples) for other, _ in known):
        return None
    return samples, np.mean([entry for _, entry in known], axis=0)


def _are_same(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether samples are the same ones, up to what machines differ in: hundredths of a millimetre."""
    return first.shape == second.shape and np.allclose(first, second, rtol=0, atol=1e-5)
