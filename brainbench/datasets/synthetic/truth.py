"""The truth beside synthetic recordings: a JSON file with the geometry that the neurons were given."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.files import read_json

TRUTH = "truth.json"


def read_truth(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the truth of synthetic recordings: labels, and RDMs [P] of ``shared`` and ``subjects``.

    Raises:
        DataError: there is none.
    """
    truth = read_json(Path(folder) / TRUTH)
    truth["shared"] = np.array(truth["shared"])
    truth["subjects"] = {name: np.array(values) for name, values in truth["subjects"].items()}
    return truth


def correlation_rdm(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation distance between rows [K, U] as an upper triangle [P]; NaN for rows without variance."""
    rows, columns = np.triu_indices(len(responses), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return 1.0 - np.atleast_2d(np.corrcoef(responses))[rows, columns]
