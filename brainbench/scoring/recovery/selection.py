"""Choice of the stimuli, out of a larger pool, that separate candidates best.

Animals are drawn as for boards, once and over the whole pool, since the RDM of fewer stimuli is a part of it. A set of
stimuli is as good as the margins by which the true candidates lead on these boards; it is improved by exchanging one
stimulus at a time. Rates must be measured on boards of other numbers (:data:`FIRST_BOARD`): on the ones that chose
they are too good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from brainbench.core.errors import UsageError, check_number
from brainbench.core.progress import Progress
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.evaluation import held_out
from brainbench.metrics.measures.metric import Metric, get_metric
from brainbench.metrics.rdms.comparison import compare_all, permuted_pairs
from brainbench.scoring.recovery.boards import SMALLEST_RDM, Candidate, RecoveryDesign, check_candidates, draw_board

BOARDS = 4  # boards of each candidate on which stimuli are chosen
FIRST_BOARD = 1_000_000  # number of the first of them, far from those on which rates are measured
EXCHANGES = 1500


@dataclass(frozen=True)
class StimulusSelection:
    """Stimuli that were picked."""

    stimuli: tuple[str, ...]
    """Names, in the order of the pool."""
    rows: tuple[int, ...]
    """Their places in the pool."""
    gain: float
    """Rise of the mean margin over the random set from which the search began, in scores."""


def select_stimuli(
    candidates: Sequence[Candidate],
    keep: int,
    design: RecoveryDesign | None = None,
    *,
    boards: int = BOARDS,
    exchanges: int = EXCHANGES,
    progress: Progress | None = None,
) -> StimulusSelection:
    """Pick the stimuli of the pool that separate the candidates best.

    Stimuli are chosen on so many ``boards`` of each candidate, whose design's own ``stimuli`` do not count.
    """
    design = replace(design or RecoveryDesign(), stimuli=None)
    check_candidates(candidates, design, boards)
    pool = len(candidates[0].stimuli)
    check_number(f"Stimuli to keep of the {pool} of the pool", keep, least=SMALLEST_RDM, most=pool, whole=True)
    check_number("The number of exchanges", exchanges, least=0, whole=True)
    metric = get_metric(design.metric)
    if not metric.of_rdms:
        raise UsageError(f"Stimuli are chosen by RDMs; the metric {metric.name!r} does not compare any, 'rsa' does.")
    margins = Margins(candidates, design, metric, boards)
    random = np.random.default_rng([design.seed, FIRST_BOARD])
    order = random.permutation(pool)
    chosen, spare = order[:keep].copy(), order[keep:].copy()
    first = margins(chosen)
    # A margin far above zero is not worth more than one that is safely above it.
    scale = float(np.abs(first).mean()) or 1.0
    best = _worth(first, scale)
    if not len(spare):
        exchanges = 0
    for tried in range(exchanges):
        out, new = int(random.integers(keep)), int(random.integers(len(spare)))
        chosen[out], spare[new] = spare[new], chosen[out]
        worth = _worth(margins(chosen), scale)
        if worth > best:
            best = worth
        else:
            chosen[out], spare[new] = spare[new], chosen[out]
        if progress is not None and (tried + 1) % 25 == 0:
            progress(tried + 1, exchanges, "exchanging stimuli")
    rows = np.sort(chosen)
    gain = float(margins(rows).mean() - first.mean())
    return StimulusSelection(tuple(candidates[0].stimuli[row] for row in rows), tuple(rows.tolist()), gain)


def keep_stimuli(candidates: Sequence[Candidate], rows: Sequence[int]) -> tuple[Candidate, ...]:
    """Return the candidates with some of their stimuli alone."""
    names, reduced = tuple(candidates[0].stimuli[row] for row in rows), []
    for candidate in candidates:
        layers = {layer: values[list(rows)] for layer, values in candidate.features.items()}
        reduced.append(Candidate.of(candidate.name, names, layers, candidate.weights))
    return tuple(reduced)


def _worth(margins: Floats, scale: float) -> float:
    return float(np.tanh(margins / scale).mean())


class Margins:
    """Leads [boards] of the true candidates over the best of the others, for any set of stimuli."""

    def __init__(self, candidates: Sequence[Candidate], design: RecoveryDesign, metric: Metric, boards: int) -> None:
        self.comparison = metric.comparison
        self.pool = len(candidates[0].stimuli)
        rdms = [np.stack(list(item.layers(metric).values())) for item in candidates]
        self.layers, self.ends = np.concatenate(rdms), np.cumsum([0, *map(len, rdms)])
        drawn = []
        self.true = np.repeat(np.arange(len(candidates)), boards)
        for place, true in enumerate(self.true.tolist()):
            # Their reliability does not matter here, so one split is enough.
            animals = draw_board(candidates, replace(design, splits=1), true, FIRST_BOARD + place % boards)[2]
            drawn.append(np.stack([one.rdm for one in animals]))
        self.brain = np.stack(drawn)

    def __call__(self, rows: Ints) -> Floats:
        """Return the leads [boards], in scores, on the stimuli ``rows``."""
        pairs = permuted_pairs(np.sort(rows)[None], self.pool)[0]
        boards, animals = self.brain.shape[:2]
        brain = self.brain[..., pairs].reshape(boards * animals, -1)
        r = np.nan_to_num(compare_all(self.layers[:, pairs], brain, method=self.comparison), nan=-1.0)
        r = r.reshape(len(self.layers), boards, animals).swapaxes(0, 1)
        parts = [r[:, start:end] for start, end in pairwise(self.ends)]
        several = animals > 1
        # [boards, C]
        scores = np.stack([(held_out(part) if several else part.max(axis=1)).mean(axis=-1) for part in parts], axis=1)
        true_scores = np.take_along_axis(scores, self.true[:, None], axis=1)[:, 0]
        np.put_along_axis(scores, self.true[:, None], -np.inf, axis=1)
        return true_scores - scores.max(axis=1)
