"""Candidates of a recovery: networks with the features of their layers for the same stimuli.

Letters: K stimulus, F feature.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, repeats, unknown_name
from brainbench.core.files import content_hash
from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_number
from brainbench.datasets.synthetic.geometry import ResponseGeometry, principal_axes
from brainbench.metrics.measures.metric import Metric
from brainbench.scoring.options import ScoreOptions


@dataclass(frozen=True)
class Candidate:
    """A network that may have made the data."""

    name: str
    stimuli: tuple[str, ...]
    """[K] names."""
    features: Mapping[str, NDArray[np.float64]]
    """Layer → [K, F]; without layers that are the same for all stimuli or not finite."""
    weights: str | None = None
    """Content hash of its weights."""

    @classmethod
    def of(
        cls, name: str, stimuli: Sequence[str], layers: Mapping[str, ArrayLike], weights: str | None = None
    ) -> Candidate:
        """Take the layers that can be compared."""
        usable = {}
        for layer, values in layers.items():
            array = np.asarray(values, dtype=np.float64)
            if array.ndim != 2 or len(array) != len(stimuli):
                raise UsageError(f"Layer {layer!r} of {name} is {list(array.shape)}; expected [{len(stimuli)}, F].")
            if np.isfinite(array).all() and np.ptp(array, axis=0).any():
                usable[str(layer)] = array
        if not usable:
            raise UsageError(f"No layer of {name} differs between the stimuli, so nothing can be drawn from it.")
        return cls(name, tuple(stimuli), usable, weights)

    def choose(self, layer: str, random: np.random.Generator) -> str:
        """Return the layer that ``any``, ``last`` or a name means."""
        names = list(self.features)
        if layer in names:
            return layer
        if layer not in ("any", "last"):
            raise unknown_name(f"layer of {self.name}", layer, ["any", "last", *names])
        return names[-1] if layer == "last" else names[int(random.integers(len(names)))]

    def geometry(self, layer: str, rows: NDArray[np.int64]) -> ResponseGeometry:
        """Return the Euclidean geometry of a layer for some stimuli.

        Features are mixed as they are, not standardised, so that the truth is the layer's own RDM of squared
        Euclidean distances.
        """
        directions = self._axes[layer][rows]
        directions = directions - directions.mean(axis=0)
        size = np.sqrt((directions**2).sum() / len(rows))
        return ResponseGeometry(directions / (size or 1.0), tuple(self.stimuli[row] for row in rows))

    def layers(self, metric: Metric) -> dict[str, NDArray[np.float64]]:
        """Return what a metric compares of every layer, computed once."""
        key = (metric.name, str(metric))
        if key not in self._layers:
            self._layers[key] = {name: metric.layer(values) for name, values in self.features.items()}
        return self._layers[key]

    @cached_property
    def _layers(self) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
        return {}

    @cached_property
    def _axes(self) -> dict[str, NDArray[np.float64]]:
        """Layer → [K, ≤ K] stimuli on the principal axes of its features: the same distances in fewer columns."""
        return {layer: principal_axes(values - values.mean(axis=0)) for layer, values in self.features.items()}

    @property
    def identity(self) -> str:
        """Content hash of its name, stimuli and features."""
        parts = [part for layer, values in self.features.items() for part in (layer, values)]
        return content_hash(self.name, list(self.stimuli), *parts)


def open_candidates(
    models: Sequence[Any], options: ScoreOptions, *, progress: Progress | None = None
) -> tuple[tuple[Candidate, ...], dict[str, Any]]:
    """Run the models on the stimuli of ``options``; return them as candidates, and the provenance of the stimuli."""
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.stimuli import load_stimuli

    check_number("number of candidates, which a recovery tells apart,", len(models), least=2)
    # Whatever can be wrong with a name is found before stimuli are simulated.
    resolved = [resolve_model(model, seed=options.model_seed) for model in models]
    names = [item.card.name for item in resolved]
    if twice := repeats(names):
        raise UsageError(f"The candidate {twice[0]!r} is given twice; candidates have different names.")
    if any(item.labels is None for item in resolved):
        how = {"whiskers": options.whiskers, "fidelity": options.fidelity}
        shown = load_stimuli(options.stimuli or "objects", **how, progress=progress)
        options, stimuli = replace(options, stimuli=shown, whiskers="all"), shown.labels
    else:  # activations from files alone, whose labels name the stimuli
        stimuli = next(item.labels for item in resolved if item.labels)
    candidates, origin = [], {}
    for item in track(resolved, "running networks", progress):
        found = item.respond(options)
        lacking = [label for label in stimuli if label not in found.labels]
        if lacking:
            raise UsageError(f"{item.card.name} has no activations for the stimulus {lacking[0]!r}.")
        rows = [found.labels.index(label) for label in stimuli]
        candidates.append(Candidate.of(item.card.name, stimuli, found.features(rows), found.card.weights))
        origin = dict(found.origin.get("stimuli") or origin)
    return tuple(candidates), origin
