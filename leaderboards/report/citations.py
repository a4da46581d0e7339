"""Citations of a report: the BibTeX entries of ``references.bib`` that its records lead to."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from brainbench.core.records import ResultRecord
from brainbench.core.version import __version__


@dataclass(frozen=True)
class Reference:
    """One work."""

    key: str
    text: str
    """As a reader reads it."""
    bibtex: str


@cache
def _works() -> dict[str, Reference]:
    """Return the entries of ``references.bib`` by key: one field a line, entries set apart by an empty line."""
    entries = Path(__file__).with_name("references.bib").read_text(encoding="utf-8").strip().split("\n\n")
    return {work.key: work for work in map(_work, entries)}


def _work(bibtex: str) -> Reference:
    fields = dict(re.findall(r"^  (\w+) = \{(.*)\},?$", bibtex, re.MULTILINE))
    names = [name.partition(",")[0] for name in fields["author"].split(" and ")]
    who = " and ".join(names) if len(names) < 3 else f"{names[0]} et al."
    place = fields.get("journal") or fields["booktitle"]
    place += f" {fields['volume']}" if "volume" in fields else ""
    key = bibtex.partition("{")[2].partition(",")[0]
    return Reference(key, f"{who} ({fields['year']}). {fields['title'].strip('{}')}. {place}.", bibtex)


_ARCHITECTURES = {
    "Zhuang, Kubilius": "zhuang2017",
    "He, Zhang": "he2016",
    "Gu, Goel": "gu2022",
    "Gu & Dao": "gu2023",
    "Radford, Wu": "radford2019",
}
_OBJECTIVES = {"simclr": "chen2020", "simsiam": "chen2021"}
_METRICS = {"crossnobis": "walther2016", "cka": "kornblith2019", "procrustes": "williams2021"}


def references(records: Iterable[ResultRecord]) -> list[Reference]:
    """Return the works behind the records: toolkit, recordings, statistics, architectures, objectives.

    An architecture's citation that is not known here is kept in its own words as an entry ``@misc``.
    """
    found: dict[str, Reference] = {"brainbench": _toolkit()}
    for record in records:
        score, card = record.score, record.card
        keys = []
        if "RSA" in score.metric:
            keys += ["kriegeskorte2008", "spearman1910", "brown1910"]
        if score.ceiling is not None:
            keys.append("nili2014")
        keys += [key for word, key in _METRICS.items() if word in score.metric.lower()]
        if "rodgers" in f"{score.provenance.stimuli_name} {score.provenance.recordings_name}".lower():
            keys.append("rodgers2022")
        if card is not None:
            keys += [key for words, key in _ARCHITECTURES.items() if words in (card.citation or "")]
            keys += [_OBJECTIVES[card.objective]] if card.objective in _OBJECTIVES else []
            keys += ["wilson1927"] if card.accuracy_interval is not None else []
            if card.citation and not any(words in card.citation for words in _ARCHITECTURES):
                other = _other(card.citation)
                found.setdefault(other.key, other)
        for key in keys:
            found.setdefault(key, _works()[key])
    return list(found.values())


def _toolkit() -> Reference:
    title = "brainbench: which artificial networks process touch the way a brain does"
    body = f"  author = {{{{The brainbench developers}}}},\n  title = {{{{{title}}}}},\n  year = {{2026}},\n"
    return Reference(
        "brainbench",
        f"The brainbench developers (2026). {title}. Version {__version__}.",
        f"@software{{brainbench,\n{body}  version = {{{__version__}}}\n}}",
    )


def _other(text: str) -> Reference:
    key = re.sub(r"[^a-z0-9]+", "", text.lower())[:24] or "other"
    safe = re.sub(r"[{}\\\n]", " ", text)
    return Reference(key, text, f"@misc{{{key},\n  note = {{{safe}}}\n}}")
