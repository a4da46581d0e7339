"""Synthetic recordings whose truth is known: geometry, neurons, sessions, files, and the demo recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.datasets.synthetic.animals import FAULTS, SyntheticAnimal, calibrate, measure_ceiling, simulate
    from brainbench.datasets.synthetic.demo import ensure_demo
    from brainbench.datasets.synthetic.design import Design, stimulus_means
    from brainbench.datasets.synthetic.geometry import ResponseGeometry
    from brainbench.datasets.synthetic.sessions import as_recordings, make_sessions, write_files

__all__ = [
    "FAULTS",
    "Design",
    "ResponseGeometry",
    "SyntheticAnimal",
    "as_recordings",
    "calibrate",
    "ensure_demo",
    "make_sessions",
    "measure_ceiling",
    "simulate",
    "stimulus_means",
    "write_files",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Design": ".design",
        "FAULTS": ".animals",
        "ResponseGeometry": ".geometry",
        "SyntheticAnimal": ".animals",
        "as_recordings": ".sessions",
        "calibrate": ".animals",
        "ensure_demo": ".demo",
        "make_sessions": ".sessions",
        "measure_ceiling": ".animals",
        "simulate": ".animals",
        "stimulus_means": ".design",
        "write_files": ".sessions",
    },
)
