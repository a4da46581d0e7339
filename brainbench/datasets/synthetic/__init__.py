"""Synthetic recordings whose truth is known, as arrays, sessions of spike times, or files.

A ``geometry`` (from a network's features) and a ``design`` give ``populations``: expected rates, trials and counts.
They relate a design to its noise ceiling, place spikes, and write files with the truth beside them, once per machine.
``rodgers_demo`` puts the same neurons into the task and file layout of Rodgers 2022.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.datasets.synthetic.populations import (
        PopulationDesign,
        ResponseGeometry,
        calibrate,
        draw_animals,
        measure_ceiling,
        read_truth,
        write_files,
    )
    from brainbench.datasets.synthetic.rodgers_demo import ensure_rodgers_demo, make_rodgers_demo

__all__ = [
    "PopulationDesign",
    "ResponseGeometry",
    "calibrate",
    "draw_animals",
    "ensure_rodgers_demo",
    "make_rodgers_demo",
    "measure_ceiling",
    "read_truth",
    "write_files",
]

__getattr__, __dir__ = lazy_exports(__name__)
