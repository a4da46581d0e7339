"""What a report must cite: the entries (BibTeX) that its records lead to."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from brainbench import __version__
from brainbench.core.records import ResultRecord


@dataclass(frozen=True)
class Reference:
    """One work."""

    key: str
    text: str
    """As a reader reads it."""
    bibtex: str


def _article(key: str, authors: str, year: int, title: str, journal: str, **more: str) -> Reference:
    fields = {"author": authors, "year": str(year), "title": f"{{{title}}}", "journal": journal, **more}
    kind = "article"
    if journal.startswith(("Advances", "International Conference", "IEEE Conference", "Proceedings")):
        kind, fields = "inproceedings", {("booktitle" if k == "journal" else k): v for k, v in fields.items()}
    body = ",\n".join(f"  {name} = {{{value}}}" for name, value in fields.items())
    people = authors.split(" and ")
    names = [name.partition(",")[0] for name in people]
    who = names[0] if len(names) == 1 else f"{names[0]} and {names[1]}" if len(names) == 2 else f"{names[0]} et al."
    place = f" {more['volume']}" if "volume" in more else ""
    return Reference(key, f"{who} ({year}). {title}. {journal}{place}.", f"@{kind}{{{key},\n{body}\n}}")


_WORKS = {
    work.key: work
    for work in (
        _article("kriegeskorte2008", "Kriegeskorte, Nikolaus and Mur, Marieke and Bandettini, Peter", 2008,
                 "Representational similarity analysis: connecting the branches of systems neuroscience",
                 "Frontiers in Systems Neuroscience", volume="2", pages="4"),
        _article("nili2014", "Nili, Hamed and Wingfield, Cai and Walther, Alexander and Su, Li and Marslen-Wilson, "
                 "William and Kriegeskorte, Nikolaus", 2014, "A toolbox for representational similarity analysis",
                 "PLoS Computational Biology", volume="10", pages="e1003553"),
        _article("spearman1910", "Spearman, Charles", 1910, "Correlation calculated from faulty data",
                 "British Journal of Psychology", volume="3", pages="271--295"),
        _article("brown1910", "Brown, William", 1910,
                 "Some experimental results in the correlation of mental abilities",
                 "British Journal of Psychology", volume="3", pages="296--322"),
        _article("walther2016", "Walther, Alexander and Nili, Hamed and Ejaz, Naveed and Alink, Arjen and "
                 "Kriegeskorte, Nikolaus and Diedrichsen, J{\\\"o}rn", 2016,
                 "Reliability of dissimilarity measures for multi-voxel pattern analysis", "NeuroImage", volume="137",
                 pages="188--200"),
        _article("kornblith2019", "Kornblith, Simon and Norouzi, Mohammad and Lee, Honglak and Hinton, Geoffrey", 2019,
                 "Similarity of neural network representations revisited",
                 "International Conference on Machine Learning"),
        _article("williams2021", "Williams, Alex H. and Kunz, Erin and Kornblith, Simon and Linderman, Scott W.", 2021,
                 "Generalized shape metrics on neural representations",
                 "Advances in Neural Information Processing Systems", volume="34"),
        _article("rodgers2022", "Rodgers, Chris C.", 2022,
                 "A detailed behavioral, videographic, and neural dataset on object recognition in mice",
                 "Scientific Data", volume="9", pages="620"),
        _article("zhuang2017", "Zhuang, Chengxu and Kubilius, Jonas and Hartmann, Mitra J. Z. and Yamins, Daniel L. K.",
                 2017, "Toward goal-driven neural network models for the rodent whisker-trigeminal system",
                 "Advances in Neural Information Processing Systems", volume="30"),
        _article("he2016", "He, Kaiming and Zhang, Xiangyu and Ren, Shaoqing and Sun, Jian", 2016,
                 "Deep residual learning for image recognition",
                 "IEEE Conference on Computer Vision and Pattern Recognition"),
        _article("gu2022", "Gu, Albert and Goel, Karan and R{\\'e}, Christopher", 2022,
                 "Efficiently modeling long sequences with structured state spaces",
                 "International Conference on Learning Representations"),
        _article("gu2023", "Gu, Albert and Dao, Tri", 2023,
                 "Mamba: linear-time sequence modeling with selective state spaces", "arXiv", eprint="2312.00752"),
        _article("radford2019", "Radford, Alec and Wu, Jeffrey and Child, Rewon and Luan, David and Amodei, Dario and "
                 "Sutskever, Ilya", 2019, "Language models are unsupervised multitask learners",
                 "OpenAI technical report"),
        _article("chen2020", "Chen, Ting and Kornblith, Simon and Norouzi, Mohammad and Hinton, Geoffrey", 2020,
                 "A simple framework for contrastive learning of visual representations",
                 "International Conference on Machine Learning"),
        _article("chen2021", "Chen, Xinlei and He, Kaiming", 2021, "Exploring simple Siamese representation learning",
                 "IEEE Conference on Computer Vision and Pattern Recognition"),
        _article("wilson1927", "Wilson, Edwin B.", 1927, "Probable inference, the law of succession, and statistical "
                 "inference", "Journal of the American Statistical Association", volume="22", pages="209--212"),
    )
}  # fmt: skip

_ARCHITECTURES = {
    "Zhuang, Kubilius": "zhuang2017",
    "He, Zhang": "he2016",
    "Gu, Goel": "gu2022",
    "Gu & Dao": "gu2023",
} | {"Radford, Wu": "radford2019"}
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
            found.setdefault(key, _WORKS[key])
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
