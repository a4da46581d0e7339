"""Options of a score, stated once.

The flags of ``brainbench score``, the keywords of :func:`brainbench.score`, the ``[options]`` of a batch file of
``brainbench leaderboard add``, and the settings in a record's provenance are these fields.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from brainbench.core.contracts import BY_TRIAL
from brainbench.core.errors import UsageError, brief, check_each, check_once
from brainbench.core.limits import Limit, Positive, Seed, limited

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.datasets.trials.selection import Selection, Window
    from brainbench.metrics import Metric
    from brainbench.stimuli import Fidelity, Stimuli

TIME_BIN = 0.05  # bin width of scores over time, seconds

_OF_PYTHON = ("recordings", "stimuli", "match", "select", "window", "fidelity", "metric", "benchmark")
"""Fields that take much in Python, and a number nowhere; a batch file can hold one."""
_ELSEWHERE = ("recordings", "match", "by", "explain", "title", "strict", "memory", "plan", "benchmark")
"""Fields whose effect stands in other entries of the provenance (``recordings``, ``pairs``, ``statistics``, ``plan``,
``benchmark``), or in none."""


@limited(
    names={"time": "time rule"},
    unresolved=_OF_PYTHON,
)
class ScoreOptions:
    """Options of scoring a model against recordings."""

    recordings: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | xr.Dataset = "demo"
    """'demo' or 'demo-rodgers' (synthetic), an NWB, HDF5 or published .npz file, a folder, or a glob; in Python also a
    data set."""
    title: str | None = None
    """Title of the recordings in results; by default the name of their file or folder."""
    stimuli: str | os.PathLike[str] | Stimuli | xr.Dataset | None = None
    """A recipe, a scene file, a stimulus-set file, or an HDF5 array; by default what the recordings name."""
    conditions: str | None = None
    """TABLE:COLUMN[,COLUMN] of the recordings that labels the trials; see 'recordings inspect'."""
    match: Path | str | Mapping[str, str | None] | None = None
    """JSON, TOML or CSV file: recording label → stimulus label (null drops one); equal labels need none. 'trial': each
    trial has a stimulus of its own, named after it."""
    select: str | Selection | None = None
    """Trials and units to use, e.g. 'outcome=correct; units.layer=4', or a name."""
    window: str | Window | None = None
    """Part of a trial to read, e.g. 'first-contact..choice', 'start..+1 minus start-0.5..start' (a baseline) or
    'start..+1 of LFP@70..150' (a signal, and its band in Hz)."""
    strict: bool = False
    """Refuse a folder with files that hold no recordings, instead of skipping them and saying so."""
    whiskers: str = "all"
    """Whiskers to simulate: all, C0-C3, C2,D1, …"""
    fidelity: str | Fidelity | None = "balanced"
    """Simulation preset: balanced, accurate, or fast (to try things out; coarse RDMs); single values may follow, as in
    fast,links=12,time_step=5e-4."""
    layers: Annotated[tuple[str, ...], Limit(shortest=1)] | None = None
    """Comma-separated layers to compare; all by default."""
    layer: str | None = None
    """The layer committed to before anything is scored; by default the one that the model names, else a held-out
    choice among all."""
    time: Literal["mean", "concatenate"] = "mean"
    """Time axis of both sides: 'mean' averages over it, 'concatenate' keeps every step."""
    bin: Positive | None = None
    """Bin width of the spike counts in seconds."""
    over_time: bool = False
    """Also score each time, in bins of --bin (.05 s), and measure each layer's latency (RSA metrics only)."""
    by: str | None = None
    """Also score and rank each group of units: area, layer or cell_type, or some as in 'area=S1|M1'."""
    estimator: str = "default"
    """default, thesis or thesis-input (as published)."""
    metric: str | Metric = "rsa"
    """rsa, rsa-correlation, rsa-crossnobis, rsa-partial, cka, decoding, ridge, procrustes, soft-matching, one-to-one,
    or FILE.py:CLASS of your own."""
    units_reliability: Annotated[float, Limit(above=-1, below=1)] | None = None
    """Leave out units whose tuning is less reliable than this (published: .5); a choice made on the scored data."""
    normalize: bool = True
    """Give plain modules forces in 1e-4 N and moments in 1e-6 N·m instead of SI; other models take no choice."""
    seed: Seed = 0
    """Seed of untrained weights, of split halves and of random features."""
    weights_seed: Seed | None = None
    """Seed of untrained weights alone; --seed then keeps that of the statistics."""
    readout: Literal["default", "published"] = "default"
    """Layers and steps of a network of the study: default (ours), or published (its names, its steps, its averages)."""
    memory: Positive = 2.0
    """Memory for the activations of a model, GiB; layers beyond it lie in temporary files."""
    plan: Path | str | None = None
    """Sealed plan that 'power' or 'recovery' wrote with --plan; what the score does otherwise is marked."""
    explain: bool = False
    """Also walk from the published estimator to the default one, fault by fault (RSA only); MODEL may then be an .npz
    of stored splits (arrays r_xy, r_yy and r_xx)."""
    benchmark: str | os.PathLike[str] | None = None
    """File (.toml, .zip) or name of a benchmark, which states the recordings and all that is compared; it takes the
    place of the options for these."""

    def __post_init__(self) -> None:
        """Refuse what no score can be made with, before anything is loaded."""
        for name in _OF_PYTHON:
            if isinstance(getattr(self, name), (int, float)):
                raise UsageError(f"{name} must be a text; received {brief(getattr(self, name))}.")
        if isinstance(self.match, os.PathLike) and os.fspath(self.match) == BY_TRIAL:  # as the command line states it
            object.__setattr__(self, "match", BY_TRIAL)
        if self.layers is not None:
            check_once("layers", self.layers)
            object.__setattr__(self, "layers", tuple(self.layers))
        if not isinstance(self.recordings, (str, os.PathLike, Sequence)):
            for name in ("conditions", "select", "window", "bin"):
                if getattr(self, name) is not None:
                    raise UsageError(f"Recordings in memory are counted already, so {name} cannot apply; leave it out.")
        if self.readout == "published" and (self.time != "mean" or self.over_time):
            raise UsageError("The published readout averages time by its own rule; leave out --time and --over-time.")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> ScoreOptions:
        """Return the options that a mapping of names and values states."""
        names = [item.name for item in fields(cls)]
        check_each("option of a score", values, names)
        return cls(**values)

    @classmethod
    def stated_in(cls, settings: Mapping[str, Any], **others: Any) -> ScoreOptions:
        """Return the options that the settings of a provenance state, and others that they do not hold."""
        from brainbench.stimuli.sources import is_finished

        names = {item.name for item in fields(cls)} - {*_ELSEWHERE}
        stated = {name: value for name, value in settings.items() if name in names and value is not None}
        if is_finished(stated.get("stimuli", "")):  # of an earlier record, which states one all the same
            stated.pop("fidelity", None)
        if isinstance(stated.get("fidelity"), Mapping):  # of the caller's own: its fields, as JSON states a dataclass
            from brainbench.stimuli import Fidelity

            before = {item.name: item.metadata["before"] for item in fields(Fidelity) if "before" in item.metadata}
            values = before | dict(stated["fidelity"])
            changes = (f"{name}={str(value).lower()}" for name, value in values.items())
            stated["fidelity"] = ",".join(["balanced", *changes])
        return cls.of(stated | others)

    @property
    def model_seed(self) -> int:
        """Seed of untrained weights."""
        return self.seed if self.weights_seed is None else self.weights_seed

    @property
    def selection(self) -> dict[str, Any]:
        """Arguments of :func:`brainbench.datasets.open_recordings`."""
        width = TIME_BIN if self.over_time and self.bin is None else self.bin
        stated = {name: getattr(self, name) for name in ("conditions", "select", "window", "strict")}
        return {**stated, "bin": width}

    @property
    def settings(self) -> dict[str, Any]:
        """Options as a record states them: texts and numbers; no fidelity for finished stimuli."""
        from brainbench.stimuli.sources import is_finished

        stated = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in _ELSEWHERE}
        # Stimuli in memory have no name; their hash stands in the provenance.
        has_name = isinstance(self.stimuli, (str, os.PathLike, type(None)))
        texts = {"select": self.select, "window": self.window, "stimuli": self.stimuli if has_name else "data"}
        stated |= {name: value if value is None else str(value) for name, value in texts.items()}
        metric = self.metric if isinstance(self.metric, str) else self.metric.name
        finished = self.stimuli is not None and is_finished(self.stimuli)
        fidelity = None if finished else self.fidelity or "balanced"
        return stated | {"fidelity": fidelity, "metric": metric, "weights_seed": self.model_seed}
