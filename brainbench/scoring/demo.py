"""Demo recordings by name: synthetic animals that felt simulated stimuli, made once per machine.

``demo``: ten animals whose neurons mix the units of one layer of a hidden network, one of the shipped trained models
(:data:`HIDDEN_NETWORK`), on the recipe ``objects``. A board on them has a known right answer.
``demo-rodgers``: four animals in the task and files of Rodgers (2022), on the recipe ``rodgers``; six stimuli are too
few to tell models apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.files import content_hash, file_hash, read_json
from brainbench.core.progress import Progress

if TYPE_CHECKING:
    from numpy.typing import NDArray

DEMOS = {"demo": "objects", "demo-rodgers": "rodgers"}
"""Names of the demo recordings, each with the recipe of its stimuli."""
HIDDEN_NETWORK, HIDDEN_LAYER = "resnet18-small+gpt.simclr", "attender.lm_head"
"""The network whose units the neurons of ``demo`` mix, and the layer, averaged over time."""
VERSION = 4  # raised when the same stimuli and network give other spikes in `demo`, so that old caches are not reused
_SEED = 18


def demo_recordings(name: str = "demo", *, progress: Progress | None = None) -> Path:
    """Return the folder of demo recordings, one of :data:`DEMOS`, made on first use.

    ``truth.json`` beside the files says what their neurons encode.
    """
    from brainbench.datasets.synthetic import PopulationDesign
    from brainbench.datasets.synthetic.populations import ensure_recordings
    from brainbench.datasets.synthetic.rodgers_demo import ensure_rodgers_demo
    from brainbench.models.registry import locate_model
    from brainbench.stimuli import load_stimuli

    stimuli = load_stimuli(DEMOS[name], progress=progress)
    if name == "demo-rodgers" and stimuli.dataset is not None:
        return ensure_rodgers_demo(stimuli.dataset, progress=progress)
    weights_file, design = locate_model(HIDDEN_NETWORK).weights, PopulationDesign()
    weights = file_hash(weights_file) if weights_file else None
    made_of = (stimuli.config_hash, weights, design, HIDDEN_NETWORK, HIDDEN_LAYER, VERSION, _SEED)
    origin = {"stimuli_hash": stimuli.content_hash, "weights": weights, "config_hash": content_hash(name, *made_of)}

    def make(folder: Path) -> None:
        """Write the recordings into a new folder."""
        from brainbench.datasets.synthetic import ResponseGeometry, write_files
        from brainbench.datasets.synthetic.populations import squared_euclidean_rdm

        write_files(
            folder,
            ResponseGeometry.from_activations(hidden_features(stimuli.input), stimuli.labels),
            design,
            seed=_SEED,
            stimuli=DEMOS[name],
            distance=squared_euclidean_rdm,
            progress=progress,
            network=HIDDEN_NETWORK,
            layer=HIDDEN_LAYER,
            distances="squared Euclidean",
            version=VERSION,
            **origin,
        )

    return ensure_recordings(name, origin, design, HIDDEN_NETWORK, HIDDEN_LAYER, VERSION, _SEED, make=make)


def hidden_features(stimuli: Any) -> NDArray[np.float64]:
    """Return what the neurons of ``demo`` mix [K, F] for stimuli [K, T, …], equal on every processor.

    In single precision processors differ by 1e-5, which changes counts, and one more number that is drawn for a count
    shifts all later draws of a session. In double precision they agree far below what decides a count.
    """
    from brainbench.models.activations import extract
    from brainbench.models.registry import locate_model

    network = locate_model(HIDDEN_NETWORK).build(_SEED).double()
    return extract(network, stimuli, layers=(HIDDEN_LAYER,))[HIDDEN_LAYER].mean(axis=1, dtype=np.float64)


def demo_identity(folder: Path, attributes: Mapping[str, Any]) -> str:
    """Return the hash of how demo recordings were made and what was read of them, equal on every machine.

    Where stimuli are simulated anew, a processor's last digits are in the rates, and so may be in some spikes.
    ``attributes`` are those of the opened recordings.
    """
    from brainbench.datasets.synthetic.populations import TRUTH

    read = [attributes.get(name) for name in ("conditions", "window", "bin", "selection")]
    return content_hash(read_json(folder / TRUTH)["config_hash"], *read)
