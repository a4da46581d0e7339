"""Origin of a score: versions, machine, data with hashes, settings and the command that makes it again."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from brainbench.core.errors import listing
from brainbench.core.files import content_hash


@dataclass(frozen=True)
class UniquePart:
    """What a network explains beyond controls, in parts of what is reliable.

    Equal distances (of RDMs) or the mean response (of ridge) explain 0, all that is reliable is 1. ``total`` is the sum
    of ``unique``, ``shared`` and ``controls_alone``. A number is NaN where there is none.
    """

    status: str
    reasons: tuple[str, ...] = ()
    unique: float = math.nan
    """What the network explains beyond the controls."""
    low: float = math.nan
    """Interval of ``unique``, over animals and stimuli."""
    high: float = math.nan
    total: float = math.nan
    """What network and controls explain together."""
    shared: float = math.nan
    """What either explains; negative where one hides the other."""
    controls_alone: float = math.nan
    """What the controls explain beyond the network."""
    controls: tuple[str, ...] = ()
    layer: str | None = None
    """The layer chosen most often."""
    monte_carlo_error: float = math.nan
    """Standard error of ``unique`` from the number of random halves."""

    @classmethod
    def of(cls, stated: Mapping[str, Any]) -> UniquePart:
        """Return what a mapping states; numbers that are none are NaN: a record is data that anyone may write."""

        def number(value: Any) -> float:
            """Return a finite number as it is; NaN for all else."""
            real = isinstance(value, (int, float)) and not isinstance(value, bool)
            return float(value) if real and abs(value) <= sys.float_info.max else math.nan

        def texts(value: Any) -> tuple[str, ...]:
            """Return the texts of a list; nothing for all else."""
            return tuple(map(_text, value)) if isinstance(value, (list, tuple)) else ()

        span = stated.get("interval")
        low, high = span if isinstance(span, (list, tuple)) and len(span) == 2 else (math.nan, math.nan)
        kinds = {"reasons": texts, "controls": texts, "status": _text, "layer": lambda value: _text(value) or None}
        values = {item.name: kinds.get(item.name, number)(stated.get(item.name)) for item in fields(cls)}
        return cls(**{**values, "low": number(low), "high": number(high)})

    @property
    def stated(self) -> dict[str, Any]:
        """What a record keeps."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.name not in ("low", "high")}
        span = [self.low, self.high] if math.isfinite(self.low + self.high) else None
        return {**values, "reasons": list(self.reasons), "controls": list(self.controls), "interval": span}


@dataclass(frozen=True, eq=False)
class Provenance(Mapping[str, Any]):
    """Origin of a score. Read as a mapping it has the entries that are stated, as the JSON has."""

    version: str = ""
    """Version of this package that made the score."""
    time: str = ""
    """When, in ISO format."""
    machine: str = ""
    """Operating system and processor."""
    python: str = ""
    packages: Mapping[str, str] = field(default_factory=dict)
    """Versions of the packages that numbers may depend on."""
    seconds: float = 0.0
    """Time that the computation took [s]."""
    command: str = ""
    """Command line that makes the score again."""
    benchmark: Mapping[str, Any] = field(default_factory=dict)
    """``name``, ``hash``, ``citation`` and origin of the benchmark that was scored on; empty for none."""
    recordings: Mapping[str, Any] = field(default_factory=dict)
    """``source``, ``content_hash``, ``window``, ``selection``, ``removed``, ``synthetic`` and ``citation`` of the
    recordings, and ``config_hash`` of the demo, which names it on every machine."""
    stimuli: Mapping[str, Any] = field(default_factory=dict)
    """``description``, ``content_hash``, ``config_hash`` and ``backend``; empty for features computed elsewhere."""
    pairs: Mapping[str, str | None] = field(default_factory=dict)
    """Recording label → stimulus label; None for one that was dropped."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Options of the run, from which the same score can be computed again."""
    statistics: Mapping[str, Any] = field(default_factory=dict)
    """Additions of single metrics and tests: layer tests, bootstrap, accuracies, shares of variance."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """All else that was stated, and entries of another kind than above: a record is data that anyone may write."""

    @classmethod
    def of(cls, stated: Mapping[str, Any]) -> Provenance:
        """Return the provenance that a mapping states; as a mapping it is equal to that."""
        kinds = {item.name: {"str": str, "float": (int, float)}.get(str(item.type), Mapping) for item in fields(cls)}
        del kinds["more"]
        fits = (name for name, value in stated.items() if value and isinstance(value, kinds.get(name, ())))
        typed: dict[str, Any] = {name: stated[name] for name in fits}
        return cls(**typed, more={name: value for name, value in stated.items() if name not in typed})

    @property
    def recordings_name(self) -> str:
        """Title that the user gave the recordings, else the last part of each path, or ``unnamed recordings``."""
        if title := _text(self.recordings.get("title")):
            return title
        source = self.recordings.get("source")
        sources = source if isinstance(source, (list, tuple)) else [source] if source else []
        names = [str(item).replace("\\", "/").rstrip("/").rpartition("/")[2] for item in sources]
        return listing(names, limit=3, quoted=False) if any(names) else "unnamed recordings"

    @property
    def recordings_hash(self) -> str | None:
        """Hash that names the recordings, if stated.

        Of demo recordings it is that of how they were made, as for stimuli; of all others that of their content.
        """
        return _text(self.recordings.get("config_hash")) or _text(self.recordings.get("content_hash")) or None

    @property
    def benchmark_name(self) -> str:
        """Name of the benchmark; empty if none is stated."""
        return _text(self.benchmark.get("name"))

    @property
    def citations(self) -> list[str]:
        """Works that the recordings and the benchmark ask to cite, in their own words, and the benchmark's data."""
        works = [_text(origin.get("citation")) for origin in (self.recordings, self.benchmark)]
        source, doi, version = (_text(self.benchmark.get(name)) for name in ("source", "doi", "version"))
        doi = doi.rpartition("doi.org/")[2].removeprefix("doi:").strip()
        if doi and not any(doi.lower() in work.lower() for work in works):
            works.append(
                ", ".join(filter(None, (f"Recordings of {self.benchmark_name}", source, version, f"doi:{doi}")))
            )
        return [*dict.fromkeys(filter(None, works))]

    @property
    def stimuli_name(self) -> str:
        """Description of the stimuli; empty if not stated."""
        return _text(self.stimuli.get("description"))

    @property
    def stimuli_hash(self) -> str | None:
        """Hash that names the stimuli, if stated.

        That of their configuration is equal on every machine; the numbers differ in their last digits.
        """
        return _text(self.stimuli.get("config_hash")) or _text(self.stimuli.get("content_hash")) or None

    @property
    def pairing(self) -> str:
        """Name of the pairing of labels that are not equal on both sides; empty where all are."""
        renamed = [f"{label} = {stimulus}" for label, stimulus in self.pairs.items() if stimulus not in (None, label)]
        return f"{listing(renamed, limit=1)}; {content_hash(renamed, length=8)}" if renamed else ""

    @property
    def time_rule(self) -> str:
        """Use of the time axis in the RDMs, ``mean`` or ``concatenate``; empty if not stated."""
        return _text(self.settings.get("time"))

    @property
    def layer_p(self) -> dict[str, float]:
        """Each layer's p, corrected for the number of layers where that is stated."""
        tests = self.statistics.get("layer_tests")
        values = {}
        for test in tests if isinstance(tests, (list, tuple)) else ():
            if isinstance(test, Mapping) and isinstance(test.get("layer"), str):
                p = test.get("p_corrected", test.get("p"))
                if isinstance(p, (int, float)) and not isinstance(p, bool):
                    values[test["layer"]] = float(p)
        return values

    @property
    def unique(self) -> UniquePart | None:
        """What a network explains beyond controls; None where nothing is stated of it."""
        stated = self.statistics.get("unique")
        return UniquePart.of(stated) if isinstance(stated, Mapping) else None

    def __getitem__(self, name: str) -> Any:
        """Return a stated entry."""
        return self._stated()[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the stated entries."""
        return iter(self._stated())

    def __len__(self) -> int:
        """Return the number of stated entries."""
        return len(self._stated())

    def _stated(self) -> dict[str, Any]:
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {**values.pop("more"), **{name: value for name, value in values.items() if value}}


def _text(value: Any) -> str:
    """Return a text as it is; what is none counts as not stated, since anyone may write a record."""
    return value if isinstance(value, str) else ""
