"""The brain's side of a score: recordings, and every animal's RDM with its split halves."""

from __future__ import annotations

import glob
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import BY_TRIAL, as_label, join_labels, natural_key
from brainbench.core.errors import DataError, UsageError, brief, check_each, check_name, check_once, listing, repeats
from brainbench.core.files import content_hash
from brainbench.core.progress import Progress, track
from brainbench.scoring.demo import DEMOS, HIDDEN_NETWORK, demo_identity, demo_recordings

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from brainbench.core.contracts import Trials
    from brainbench.metrics import Metric
    from brainbench.scoring.options import ScoreOptions

BY_CHANCE = 0.5  # share of the tuning by chance above which scores of chosen units err by more than some 10 %
PUBLISHED_LAYOUT = "published-npz"  # layout of files of rates whose zeros the published estimators count


@dataclass(frozen=True)
class NeuralResponses:
    """Opened recordings."""

    dataset: xr.Dataset
    source: str
    """Short name of where they come from, without private folders."""
    title: str | None = None
    """Title that the user gave."""
    definition: str = ""
    """Hash of how demo recordings were made (:func:`brainbench.scoring.demo.demo_identity`); empty for all others."""

    covariates: bool = False
    """True for a metric whose scores depend on contacts, licks and choices too."""

    @property
    def vocabulary(self) -> tuple[str, ...]:
        """Ordered condition labels."""
        return tuple(self.dataset.attrs["vocabulary"])

    @property
    def stimuli(self) -> str | None:
        """Recipe of the stimuli that the animals felt; None where the recordings name none."""
        return self.dataset.attrs.get("stimuli") or None

    @property
    def synthetic(self) -> bool:
        """True when the recordings were made by a program."""
        return bool(self.dataset.attrs["synthetic"])

    @cached_property
    def content_hash(self) -> str:
        """Hash of the recordings: the one that they state, or another one for a part or an edited copy of them.

        That of covariates is part of it where the metric takes them.
        """
        from brainbench.datasets.trials.counting import COVARIATES
        from brainbench.datasets.trials.session_trials import NAMES, fingerprint

        data, stated = self.dataset, str(self.dataset.attrs["content_hash"])
        if data.attrs.get("fingerprint") not in (None, fingerprint(data)):
            arrays = [data[name].values for name in ("counts", "duration")]
            stated = content_hash(stated, *arrays, *(data[name].values.astype(str).tolist() for name in NAMES))
        covariates = {name: data[name].values.tolist() for name in COVARIATES if name in data.coords}
        return content_hash(stated, covariates) if self.covariates and covariates else stated

    @property
    def origin(self) -> dict[str, Any]:
        """Provenance of the recordings."""
        names = ("window", "selection", "removed", "synthetic")
        # Boards of the demo say whether the network that made it was found.
        truth = {"truth": HIDDEN_NETWORK} if self.source == "demo" and self.synthetic else {}
        attributes = self.dataset.attrs
        more = {"config_hash": self.definition, "title": self.title, "citation": self.citation}
        more |= {name: attributes.get(name) for name in ("ledger", "skipped")}
        truth |= {name: value for name, value in more.items() if value}
        stated = {name: attributes[name] for name in names}
        return {"source": self.source, "content_hash": self.content_hash, **stated, **truth}

    @property
    def citation(self) -> str:
        """Work to cite for recordings of a layout that is known here; empty for what a program made."""
        from brainbench.datasets.layouts.registry import get_layout, list_layouts

        name = str(self.dataset.attrs.get("layout", "")).partition(" (")[0]
        return get_layout(name).citation if not self.synthetic and name in list_layouts() else ""

    @property
    def label_doubt(self) -> str:
        """Reason why the labels cannot be trusted; empty where they can."""
        return str(self.dataset.attrs.get("label_doubt", ""))

    @property
    def dependent(self) -> bool:
        """True when so many trials share spikes with another one of their stimulus that noise looks reliable."""
        # Rows that stand twice in a table are a half; in a random order of many stimuli it is less than a third.
        return float(self.dataset.attrs.get("overlap", 0.0)) > 1 / 3

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Notes on the recordings that every result must state."""
        sides = (self.dataset[name].values[~self.of_units].tolist() for name in ("session", "subject"))
        lost = [f"session {session} of {subject}" for session, subject in dict.fromkeys(zip(*sides, strict=True))]
        notes = [f"{', '.join(lost)}: no unit is left, so the trials are left out"] if lost else []
        return (*map(str, self.dataset.attrs.get("doubts", ())), *notes)

    @cached_property
    def of_units(self) -> NDArray[np.bool_]:
        """[trial] True in sessions with units; others are no part of a score."""
        pairs = ("unit_subject", "unit_session"), ("subject", "session")
        units, trials = (zip(*(self.dataset[name].values.astype(str) for name in pair), strict=True) for pair in pairs)
        present = {*units}
        return np.array([trial in present for trial in trials], dtype=bool)

    @property
    def published(self) -> bool:
        """True for a published file of rates, whose zeros the published estimators count."""
        return self.dataset.attrs.get("layout") == PUBLISHED_LAYOUT

    def groups(self, by: str) -> dict[str, NeuralResponses]:
        """Return the parts of each group of units; those without a group are in none.

        ``by`` is a column, or ``COLUMN=a|b`` for some of its groups.
        """
        from brainbench.datasets.trials.counting import GROUPS

        column, _, words = by.partition("=")
        check_name("group of units", column, GROUPS, hint="(of --by)")
        columns = {name: self.dataset[name].values.astype(str) for name in GROUPS if name in self.dataset.coords}
        columns = {name: values for name, values in columns.items() if (values != "").any()}
        if column not in columns:
            others = f"they have {listing(columns)}" if columns else f"nor of {listing({*GROUPS} - {column})}"
            raise DataError(f"No unit of these recordings has a value of {column!r}; {others}.")
        names = sorted({*columns[column].tolist()} - {""}, key=natural_key)
        wanted = [word.strip() for word in words.split("|")] if words else names
        check_each(column, wanted, names)
        check_once("--by", wanted)
        rows = {name: np.flatnonzero(columns[column] == name) for name in wanted}
        return {name: replace(self, dataset=self.dataset.isel(unit=units)) for name, units in rows.items()}

    def stated_pairs(self, pairs: Mapping[str, str]) -> dict[str, str | None]:
        """Return pairs of labels as a record states them: None for labels that were dropped."""
        return {label: pairs.get(label) for label in self.vocabulary}

    def pairs(self, stimuli: tuple[str, ...], match: Any) -> dict[str, str]:
        """Pair recording labels with stimuli; slots without names one by one, as the published code does.

        Labels that are joined by trial are those of their trials.
        """
        if match == BY_TRIAL:
            brain = self.with_stimuli(stimuli)
            names = brain.dataset["stimulus"].values.astype(str)[brain.of_units]
            return {label: label for label in self.vocabulary if label in names}
        if self.label_doubt and match is None:
            if len(stimuli) != len(self.vocabulary):
                raise UsageError(
                    f"{self.source} has {len(self.vocabulary)} slots without names and there are {len(stimuli)} "
                    f"stimuli ({listing(stimuli, limit=6)}); use --stimuli rodgers, or --match FILE with a stimulus "
                    f"for each of {listing(self.vocabulary)}."
                )
            match = dict(zip(self.vocabulary, stimuli, strict=True))
        return join_labels(self.vocabulary, stimuli, match)

    def with_stimuli(self, stimuli: tuple[str, ...]) -> NeuralResponses:
        """Return the part of the trials that have a stimulus of their own."""
        return replace(self, dataset=self.dataset.isel(trial=self.stimulus_rows(stimuli) >= 0))

    def stimulus_rows(self, labels: tuple[str, ...], *, step: int = 0) -> NDArray[np.int64]:
        """Return the row of each trial's own stimulus [trial]; −1 where it has none.

        With ``step`` trials have the numbers so many further, and none needs a stimulus.
        """
        columns = [self.dataset[name].values.astype(str).tolist() for name in ("subject", "session", "trial_id")]
        trials, names = list(zip(*columns, strict=True)), [_trial_name(label) for label in labels]
        if twice := repeats(names):
            both = [label for label, name in zip(labels, names, strict=True) if name == twice[0]]
            raise UsageError(f"The stimuli {listing(both)} are of one trial, {brief(twice[0])}; leave out one of them.")
        places, best, shared = {name: row for row, name in enumerate(names)}, np.full(len(trials), -1), ""
        for depth in (1, 2, 3):
            every = [_trial_name("_".join(trial[-depth:]), step) for trial in trials]
            rows = np.array([places.get(name, -1) for name in every], dtype=np.int64)
            if (rows >= 0).any() and (several := repeats(every)):
                shared = f" {brief(several[0])} names several trials."
            elif (rows >= 0).sum() > (best >= 0).sum():
                best = rows
        if (best < 0).all() and not step:
            raise UsageError(
                f"No trial has a stimulus of its own: trials are {listing(map('_'.join, trials), limit=3)}, stimuli are"
                f" {listing(labels, limit=3)}.{shared} Name each track after its trial (TRIAL, SESSION_TRIAL or "
                "ANIMAL_SESSION_TRIAL)."
            )
        return best

    def reliable_trials(
        self, labels: tuple[str, ...], options: ScoreOptions, *, averaged: bool = False
    ) -> dict[str, tuple[tuple[Trials, ...], str]]:
        """Return each animal's :meth:`trials` with its reliable units, and what was left out in words.

        Units are chosen over the whole window, before their bins become features.
        """
        from brainbench.metrics.reliability.halves import reliable_units

        given, how = self.trials(labels, averaged=averaged), {"least": options.units_reliability, "seed": options.seed}
        # Without a gate no unit is judged.
        whole = given if averaged or options.units_reliability is None else self.trials(labels, averaged=True)
        return {name: reliable_units(own, len(labels), whole=whole[name], **how) for name, own in given.items()}

    def chance_doubt(self, labels: tuple[str, ...], options: ScoreOptions) -> str:
        """Return the doubt that reliable units are mostly those that pass the gate by chance; empty where they are not.

        The gate takes units on the trials that are scored, which makes noise reliable.
        """
        from brainbench.metrics.reliability.halves import tuning_by_chance

        if (least := options.units_reliability) is None:
            return ""
        blocks = [block for sessions in self.trials(labels, averaged=True).values() for block in sessions]
        share = tuning_by_chance(blocks, len(labels), least=least, seed=options.seed)
        if not share > BY_CHANCE:
            return ""
        return f"units of a reliability of {least:g}: those that shuffled labels leave have {share:.0%} of their tuning"

    def animals(
        self, labels: tuple[str, ...], metric: Metric, options: ScoreOptions, *, progress: Progress | None = None
    ) -> tuple[Any, ...]:
        """Prepare every animal by a metric over ``labels``, in that order."""
        animals = []
        longest = self.dataset["duration"].values.max(axis=0)
        share = np.where(longest > (1 - 1e-6) * longest.max(), 1.0, longest / longest.max())
        sides = self.reliable_trials(labels, options, averaged=options.time == "mean")
        for subject, (chosen, note) in track(list(sides.items()), "animals", progress):
            trials = tuple(_flat(session, share) for session in chosen)
            animal = metric.animal(subject, trials, len(labels), stimuli=labels, seed=options.seed)
            bins = max((item.responses.shape[1] for item in chosen), default=1)
            stated = {"notes": (note, *animal.notes)} if trials else {"problem": note}
            animals.append(replace(animal, units=-(-animal.units // bins), **(stated if note else {})))
        return tuple(animals)

    def trials(self, labels: tuple[str, ...], *, averaged: bool = False) -> dict[str, tuple[Trials, ...]]:
        """Return the sessions of each animal with trials of ``labels``, numbered in that order.

        ``averaged`` rates are those of the whole window.
        """
        from brainbench.datasets.trials.session_trials import trials_by_subject

        index = np.full(len(self.vocabulary), -1)
        index[[self.vocabulary.index(label) for label in labels]] = np.arange(len(labels))
        animals = {}
        for subject, sessions in trials_by_subject(self.dataset, averaged=averaged).items():
            kept_trials = [session.take(index[session.labels] >= 0) for session in sessions]
            animals[subject] = tuple(replace(item, labels=index[item.labels]) for item in kept_trials)
        return animals


def open_neural_responses(recordings: Any, *, progress: Progress | None, **selection: Any) -> NeuralResponses:
    """Open recordings; demo recordings (:data:`brainbench.scoring.demo.DEMOS`) are made on first use."""
    import xarray as xr

    from brainbench.datasets import open_recordings

    if isinstance(recordings, xr.Dataset):
        from brainbench.core.contracts import check_counts

        return NeuralResponses(check_counts(recordings, "The data set"), "data set")
    if isinstance(recordings, str) and recordings in DEMOS:
        folder = demo_recordings(recordings, progress=progress)
        dataset = open_recordings(folder, **selection, progress=progress)
        return NeuralResponses(dataset, recordings, definition=demo_identity(folder, dataset.attrs))
    several = not isinstance(recordings, (str, os.PathLike))
    name = ", ".join(map(short_name, recordings if several else [recordings]))
    return NeuralResponses(open_recordings(recordings, **selection, progress=progress), name)


def _trial_name(text: str, step: int = 0) -> str:
    """Return the name of a trial as it is compared: no zeros before numbers, the last one ``step`` further."""
    words = as_label(text.replace("/", "_")).split("_")
    words = [word.lstrip("0") or "0" if word.isdecimal() else word for word in words]
    if step and words[-1].isdecimal() and len(words[-1]) < 10:
        words[-1] = str(int(words[-1]) + step)
    return "_".join(words)


def _flat(session: Trials, share: NDArray[np.float64]) -> Trials:
    """Return trials [R, T, U] as [R, T·U]: bins are features like units, each with its share of a whole bin [T]."""
    responses = session.responses
    trials, bins, units = responses.shape
    if bins > 1 and (share < 1).any():
        # Squared distances add up over time; the rates of a bin that every window cuts short are mostly noise.
        responses = responses * np.sqrt(share)[:, None]
    # Without a trial (all had labels that were dropped) numpy cannot tell the second size.
    columns = {name: np.tile(values, bins) for name, values in session.columns.items()}
    return replace(session, responses=responses.reshape(trials, bins * units), columns=columns)


def short_name(source: str | os.PathLike[str]) -> str:
    """Return the name of a file or a folder; of a pattern, that of the folder it searches."""
    path = Path(source)
    while glob.has_magic(path.name):
        path = path.parent
    return path.name or path.resolve().name
