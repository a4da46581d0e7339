"""What counts as one brain: an animal, each of its sessions, or all animals together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.contracts import check_recordings
from brainbench.core.errors import unknown_name
from brainbench.core.files import content_hash

if TYPE_CHECKING:
    import xarray as xr

POOLS = ("subject", "session", "all")
ALL = "all"
"""Name of the one subject that pooling all animals makes."""


def pooled(dataset: xr.Dataset, by: str = "subject") -> xr.Dataset:
    """Return recordings whose subjects are animals, single sessions, or one pool of everything.

    Only names change, no count does, so whatever takes recordings (``blocks``, ``score``) then gives one
    RDM per pool: ``"subject"`` leaves the animals as they are, ``"session"`` makes every session its own
    subject ``ANIMAL/SESSION``, ``"all"`` puts all sessions of all animals into the subject ``all``.

    Raises:
        UsageError: ``by`` is none of these.
        DataError: ``dataset`` is not a recordings data set.
    """
    check_recordings(dataset)
    if by not in POOLS:
        raise unknown_name("pool", by, POOLS)
    if by == "subject":
        return dataset
    changed = {}
    for prefix in ("", "unit_"):
        subject, session = dataset[f"{prefix}subject"], dataset[f"{prefix}session"]
        pairs = zip(subject.values.astype(str).tolist(), session.values.astype(str).tolist(), strict=True)
        both = np.array([f"{animal}/{name}" for animal, name in pairs], dtype=str)
        if by == "session":
            changed[f"{prefix}subject"] = (subject.dims, both)
        else:
            # Two animals may both have a session "1"; inside the pool they must stay apart.
            changed[f"{prefix}subject"] = (subject.dims, np.full(subject.shape, ALL))
            changed[f"{prefix}session"] = (session.dims, both)
    result = dataset.assign_coords(changed)
    result.attrs = {
        **dataset.attrs,
        "pool": by,
        "missing": _missing(result),
        "content_hash": content_hash(dataset.attrs["content_hash"], by),
    }
    return result


def _missing(dataset: xr.Dataset) -> dict[str, list[str]]:
    """Subject → labels of the vocabulary without a trial."""
    subjects, stimuli = (dataset[name].values.astype(str) for name in ("subject", "stimulus"))
    gaps = {}
    for subject in dict.fromkeys(subjects.tolist()):
        have = set(stimuli[subjects == subject].tolist())
        if lacking := [label for label in dataset.attrs["vocabulary"] if label not in have]:
            gaps[subject] = lacking
    return gaps
