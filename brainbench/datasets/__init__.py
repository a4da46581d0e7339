"""Recordings of brains, and training data of whisker sweeps.

Files are found and opened (``reading``; formats in ``nwb``, ``hdf5``, ``temporaldata``), adapted by the layout of their
data set (``layouts``), counted and joined (``trials``): ``recordings`` does all of this. ``inspection`` and ``checks``
look into files, ``exports`` copies them, ``rdm_files`` keeps RDMs, ``synthetic`` makes them, ``whisking`` reads sweeps.

>>> from brainbench.datasets import open_recordings
>>> open_recordings("sessions/*.nwb", conditions="trials:stimulus")  # doctest: +SKIP
"""

from brainbench.datasets.checks.checkup import check
from brainbench.datasets.exports import export
from brainbench.datasets.hdf5 import write_recordings
from brainbench.datasets.inspection import inspect
from brainbench.datasets.layouts.registry import RecordingLayout, fetch, register_layout
from brainbench.datasets.rdm_files import StoredRDMs, read_rdms, write_rdms
from brainbench.datasets.recordings import open_recordings
from brainbench.datasets.trials.selection import Conditions, Rule, Selection, Window
from brainbench.datasets.whisking.dataset import WhiskingDataset

__all__ = [
    "Conditions",
    "RecordingLayout",
    "Rule",
    "Selection",
    "StoredRDMs",
    "WhiskingDataset",
    "Window",
    "check",
    "export",
    "fetch",
    "inspect",
    "open_recordings",
    "read_rdms",
    "register_layout",
    "write_rdms",
    "write_recordings",
]
