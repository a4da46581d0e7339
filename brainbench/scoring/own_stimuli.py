"""Stimuli of single trials: each trial meets what was simulated of its own track, and a label their mean.

Stimuli are named by trial: ``ANIMAL_SESSION_TRIAL``, ``SESSION_TRIAL`` or ``TRIAL``, whichever tells the trials apart;
TRIAL is the id of the row in its table. A network answers to the stimulus of each trial. Its features of a label are
the mean over the trials of all animals that are used.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import DataError, listing
from brainbench.scoring.neural_responses import BY_TRIAL, NeuralResponses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.scoring.model_responses import ModelResponses
    from brainbench.scoring.options import ScoreOptions

WITHOUT = "no stimulus of their own"


@dataclass(frozen=True, eq=False)
class _Means(Mapping[str, Any]):
    """Activations [label, T, F] by layer, means over the stimuli of each label, made when they are asked for."""

    activations: Mapping[str, NDArray[np.floating]]
    members: list[list[int]]

    def __getitem__(self, layer: str) -> NDArray[np.floating]:
        return mean_rows(self.activations[layer], self.members)

    def __iter__(self) -> Iterator[str]:
        return iter(self.activations)

    def __len__(self) -> int:
        return len(self.activations)


def mean_rows(values: NDArray[np.floating], members: list[list[int]]) -> NDArray[np.floating]:
    """Return the mean [K, …] of the rows of values [S, …] that belong together."""
    return np.stack([np.mean(values[rows], axis=0, dtype=np.float64) for rows in members]).astype(values.dtype)


def joined(
    brain: NeuralResponses, network: ModelResponses, options: ScoreOptions
) -> tuple[NeuralResponses, ModelResponses, dict[str, str]]:
    """Return recordings and responses that fit together, and recording labels with those of their stimuli.

    By trial, recordings keep the trials that have a stimulus of their own, and a label has the mean of its trials'
    responses. Other trials stand in the ledger and in the doubts of every score; ``strict`` refuses them.
    """
    if options.match != BY_TRIAL:
        return brain, network, brain.pairs(network.labels, options.match)
    rows, data = brain.stimulus_rows(network.labels), brain.dataset
    keep, doubts = rows >= 0, list(data.attrs.get("doubts", ()))
    sessions, ids = (data[name].values.astype(str).tolist() for name in ("session", "trial_id"))
    without = [f"{sessions[row]}_{ids[row]}" for row in np.flatnonzero(~keep)]
    if lost := len(without):
        doubts.append(f"{lost} of {len(rows)} trials have {WITHOUT} and are left out: {listing(without)}")
        if options.strict:
            raise DataError(doubts[-1] + ".")
    if unused := [label for row, label in enumerate(network.labels) if row not in rows]:
        doubts.append(f"{len(unused)} of {len(network.labels)} stimuli belong to no trial: {listing(unused)}")
    ledger = {kind: dict(numbers) for kind, numbers in data.attrs.get("ledger", {}).items()}
    if lost and "trials" in ledger:
        trials = ledger["trials"]
        entry = {"reason": WITHOUT, "number": lost, "lost": True}
        ledger["trials"] = {**trials, "read": trials["read"] - lost, "left_out": [*trials["left_out"], entry]}
    chosen = data.isel(trial=keep).assign_attrs(doubts=doubts, **({"ledger": ledger} if ledger else {}))
    names = chosen["stimulus"].values.astype(str)
    labels = tuple(label for label in brain.vocabulary if label in names)
    members = [rows[keep][names == label].tolist() for label in labels]
    means = replace(
        network,
        labels=labels,
        activations=_Means(network.activations, members),
        model_input=None if network.model_input is None else mean_rows(network.model_input, members),
        kinematics={name: mean_rows(values, members) for name, values in network.kinematics.items()},
    )
    return replace(brain, dataset=chosen), means, dict(zip(labels, labels, strict=True))
