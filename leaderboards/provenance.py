"""Where a score comes from: the parts of ``Score.provenance`` that boards and pages rely on.

``recordings`` {``source``, ``content_hash``}, ``stimuli`` {``description``, ``content_hash``} (absent
when the features were computed elsewhere), ``settings``, ``command``, ``time`` and ``version``.
Everything else in the provenance is shown as it is. Wrong kinds count as absent: a record is data
that anyone may have written.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from brainbench.core.records import Score


def recordings_name(score: Score) -> str:
    """Return a short name of the recordings: the last part of a path, or ``unnamed recordings``."""
    source = _part(score, "recordings", "source")
    sources = source if isinstance(source, (list, tuple)) else [source] if source else []
    names = [str(item).replace("\\", "/").rstrip("/").rpartition("/")[2] for item in sources]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more or "unnamed recordings"


def recordings_hash(score: Score) -> str | None:
    """Return the content hash of the recordings, if the record states it."""
    return _text(_part(score, "recordings", "content_hash"))


def stimuli_name(score: Score) -> str:
    """Return what the record says about its stimuli; empty if nothing."""
    return _text(_part(score, "stimuli", "description")) or ""


def stimuli_hash(score: Score) -> str | None:
    """Return the hash that names the stimuli, if the record states one.

    That of their configuration is equal on every machine; the numbers differ in their last digits.
    """
    return _text(_part(score, "stimuli", "config_hash")) or _text(_part(score, "stimuli", "content_hash"))


def time_rule(score: Score) -> str:
    """Return how the time axis entered the RDMs, ``mean`` or ``concatenate``; empty if not stated."""
    return _text(_part(score, "settings", "time")) or ""


def settings(score: Score) -> Mapping[str, Any]:
    """Return the settings of the scoring run; empty if not stated."""
    found = score.provenance.get("settings")
    return found if isinstance(found, Mapping) else {}


def version(score: Score) -> str:
    """Return the version of the package that made the score; empty if not stated."""
    return _text(score.provenance.get("version")) or ""


def made_at(score: Score) -> str:
    """Return the time of the scoring run in ISO format; empty if not stated."""
    return _text(score.provenance.get("time")) or ""


def recordings_part(score: Score, name: str) -> Any:
    """Return one statement on the recordings, such as ``window``; None if not stated."""
    return _part(score, "recordings", name)


def layer_p(score: Score) -> dict[str, float]:
    """Return each layer's p, corrected for the number of layers where the record says so; empty if not stated."""
    tests = _part(score, "statistics", "layer_tests")
    found = {}
    for item in tests if isinstance(tests, (list, tuple)) else ():
        if isinstance(item, Mapping) and isinstance(item.get("layer"), str):
            p = item.get("p_corrected", item.get("p"))
            if isinstance(p, (int, float)) and not isinstance(p, bool):
                found[item["layer"]] = float(p)
    return found


def command(score: Score) -> str:
    """Return the command that makes the score again; empty if not stated."""
    return _text(score.provenance.get("command")) or ""


def _part(score: Score, group: str, name: str) -> Any:
    values = score.provenance.get(group)
    return values.get(name) if isinstance(values, Mapping) else None


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) and value else None
