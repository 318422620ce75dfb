"""Does the thesis's ordering hold? Comparisons of rows, over seeds and over test samples."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ljn.report.tables import Column
from ljn.runs.sweep import Run

NUM_RESAMPLES = 1000
_SEED = 0


@dataclass(frozen=True)
class Contender:
    """A row's result in one column, to be compared.

    Attributes:
        label: The row.
        metric: The metric that is shown; None for none.
        mean: Over seeds, in the column's unit; None without a result.
        sd: Over seeds; None of fewer than two.
        thesis: The thesis's value.
        runs: Whose result it is.
    """

    label: str
    metric: str | None
    mean: float | None
    sd: float | None
    thesis: float | None
    runs: tuple[Run, ...]


@dataclass(frozen=True)
class Comparison:
    """Two rows in one column.

    Attributes:
        column: The column.
        better: Label of the row that the thesis's numbers, or else ours, put first.
        worse: Label of the other one.
        is_claim: Whether it is the thesis that puts it first.
        is_adjacent: Whether no row of the thesis lies between the two.
        lead: By how much the first is better in our runs, in the column's unit; negative where it is worse.
        spread: Standard deviation of the lead over seeds; None where a row has fewer than two.
        interval: 95 % interval of the lead over test samples, by a paired bootstrap; None where the errors of the
            same samples are not known for both.
    """

    column: Column
    better: str
    worse: str
    is_claim: bool
    is_adjacent: bool
    lead: float
    spread: float | None
    interval: tuple[float, float] | None

    @property
    def holds(self) -> bool:
        """Whether our runs agree."""
        return self.lead > 0

    @property
    def exceeds_spread(self) -> bool | None:
        """Whether the lead, whatever its sign, is larger than its spread over seeds; None with single seeds."""
        return None if self.spread is None else abs(self.lead) > self.spread


def compare(columns: Sequence[Column], contenders: Sequence[Sequence[Contender]]) -> tuple[Comparison, ...]:
    """The comparisons of a table.

    Args:
        columns: Its columns; those without a goal are not compared.
        contenders: For each column, its rows.

    Returns:
        Where the thesis has numbers, all pairs of rows that it puts in an order and that have results; where it has
        none for any row of the table, our best row and each other one.
    """
    comparisons: list[Comparison] = []
    main = next((column for column in columns if column.goal), None)
    is_claim = any(row.thesis is not None for rows in contenders for row in rows)
    for column, rows in zip(columns, contenders):
        if column.goal is None:
            continue
        pairs = _claims(column, rows) if is_claim else _best_and_others(column, rows)
        for better, worse, is_adjacent in pairs:
            assert better.mean is not None
            assert worse.mean is not None
            lead = worse.mean - better.mean if column.goal == "min" else better.mean - worse.mean
            comparisons.append(
                Comparison(
                    column=column,
                    better=better.label,
                    worse=worse.label,
                    is_claim=is_claim,
                    is_adjacent=is_adjacent,
                    lead=lead,
                    spread=None if better.sd is None or worse.sd is None else math.hypot(better.sd, worse.sd),
                    interval=_interval(better, worse) if column is main else None,
                )
            )
    return tuple(comparisons)


def count_claims(column: Column, rows: Sequence[Contender]) -> int:
    """How many pairs of rows the thesis puts in an order in a column, with results or without."""
    known = [row.thesis for row in rows if row.thesis is not None]
    return sum(first != second for first, second in combinations(known, 2)) if column.goal else 0


def verdict(comparisons: Sequence[Comparison], num_claims: int) -> tuple[bool | None, str]:
    """Whether the thesis's ordering holds, in words too.

    Args:
        comparisons: Of one or more columns; see `compare`.
        num_claims: Of these columns; see `count_claims`.

    Returns:
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
    """The 95 % interval of the mean of `worse - better` over test samples.

    Args:
        better: `(S,)`, errors, mm.
        worse: `(S,)`, errors of the same samples, mm.
        num_resamples: How often the samples are drawn anew, with replacement.
        seed: Of the drawing.

    Returns:
        Its 2.5th and 97.5th percentile, mm.
    """
    differences = np.asarray(worse, np.float64) - np.asarray(better, np.float64)
    generator = np.random.default_rng(seed)
    size = len(differences)
    means = [differences[generator.integers(size, size=size)].mean() for _ in range(num_resamples)]
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _claims(column: Column, rows: Sequence[Contender]) -> Iterator[tuple[Contender, Contender, bool]]:
    """Pairs that the thesis puts in an order, the better one first, and whether none lies between them."""
    sign = -1 if column.goal == "max" else 1
    known = [row for row in rows if row.thesis is not None]
    ranked = sorted(known, key=lambda row: sign * (row.thesis or 0.0))
    levels = sorted({sign * (row.thesis or 0.0) for row in known})
    for better, worse in combinations(ranked, 2):
        if better.thesis == worse.thesis or better.mean is None or worse.mean is None:
            continue
        ranks = [levels.index(sign * (row.thesis or 0.0)) for row in (better, worse)]
        yield better, worse, ranks[1] - ranks[0] == 1


def _best_and_others(
    column: Column, rows: Sequence[Contender]
) -> Iterator[tuple[Contender, Contender, bool]]:
    known = [row for row in rows if row.mean is not None and math.isfinite(row.mean)]
    if not known:
        return
    sign = -1 if column.goal == "max" else 1
    best = min(known, key=lambda row: sign * (row.mean or 0.0))
    for row in known:
        if row is not best:
            yield best, row, False


def _interval(better: Contender, worse: Contender) -> tuple[float, float] | None:
    first, second = _mean_errors(better), _mean_errors(worse)
    if first is None or second is None or not len(first[0]) or not _are_same(first[0], second[0]):
        return None
    return paired_bootstrap(first[1], second[1])


def _mean_errors(row: Contender) -> tuple[np.ndarray, np.ndarray] | None:
    """A row's samples and their errors (mm), each sample's mean over the runs; see `Run.sample_errors`."""
    if row.metric is None:
        return None
    found = [run.sample_errors(row.metric) for run in row.runs if run.status == "complete"]
    errors = [entry for entry in found if entry is not None]
    if not errors or len(errors) < len(found):
        return None
    samples = errors[0][0]
    if any(not _are_same(other, samples) for other, _ in errors):
        return None
    return samples, np.mean([values for _, values in errors], axis=0)


def _are_same(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether samples are the same ones, up to what machines differ in: hundredths of a millimetre."""
    return first.shape == second.shape and np.allclose(first, second, rtol=0, atol=1e-5)
