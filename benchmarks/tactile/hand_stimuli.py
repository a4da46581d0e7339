"""The Rodgers stimuli on whiskers and on a hand: dissimilarities of the input and of an encoder's features.

python -m benchmarks.tactile.hand_stimuli [--model zhuang-intersection-ln-small] [--write]
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from benchmarks.report import publish, script_parser, table
from brainbench import load_model
from brainbench.cli.stimuli.hand import objects_of
from brainbench.core.figures.style import panels, save_figure
from brainbench.metrics import compare, rdm
from brainbench.stimuli import load_stimuli
from brainbench.stimuli.stimulus_set import hash_stimulus_set
from robotics_bridge.exploration.procedures import PROCEDURES
from robotics_bridge.exploration.record import record_exploration

NAMES = {"input": "forces and moments", "encoder": "encoder of the network"}
PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-rdms.png"


def hand_input(procedure: str) -> np.ndarray:
    found = record_exploration(objects_of("rodgers", 0.055), [procedure])
    dataset = found.dataset()
    dataset.attrs["content_hash"] = hash_stimulus_set(dataset)
    return load_stimuli(dataset).input


def views(name: str, stimuli: np.ndarray) -> dict[str, np.ndarray]:
    """Normalised input and encoder features, over time and places."""
    model, values = load_model(name), torch.from_numpy(stimuli)
    with torch.no_grad():
        shown = {"input": model.normaliser(values), "encoder": model.encode(values)}
    return {row: value.flatten(1).numpy() for row, value in shown.items()}


def draw(rdms: dict[tuple[str, str], np.ndarray], labels: list[str], columns: list[str], rows: list[str]) -> None:
    size = (1.9 * len(columns) + 2.2, 2.0 * len(rows) + 1.6)
    figure, axes = panels(len(rows), len(columns), size, sharex=True, sharey=True)
    shown = None
    upper = np.triu_indices(6, 1)
    for row, axis_row in zip(rows, axes, strict=True):
        for column, axis in zip(columns, axis_row, strict=True):
            square = np.zeros((6, 6))
            square[upper] = rdms[column, row]
            square += square.T
            shown = axis.imshow(square / square.max(), cmap="magma", vmin=0, vmax=1)
            axis.set_xticks(range(6), labels, rotation=90)
            axis.set_yticks(range(6), labels)
            if row == rows[0]:
                axis.set_title(column.replace(", ", ",\n"))
            if column == columns[0]:
                axis.set_ylabel(NAMES[row])
    figure.colorbar(shown, ax=axes, label="dissimilarity (1 − Pearson, share of the panel's largest)", shrink=0.8)
    save_figure(figure, PICTURE, dpi=120)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--model", default="zhuang-intersection-ln-small")
    options = parser.parse_args()
    whiskers = load_stimuli("rodgers", backend="rod")
    inputs = {"whiskers": whiskers.input}
    inputs |= {f"hand, {name.replace('_', ' ')}": hand_input(name) for name in PROCEDURES}
    rows = ["input", "encoder"]
    rdms = {}
    for column, stimuli in inputs.items():
        for row, values in views(options.model, stimuli).items():
            rdms[column, row] = np.asarray(rdm(values))
            print(column, row, rdms[column, row].round(3), flush=True)
    lines = []
    for column in list(inputs)[1:]:
        found = [f"{float(compare(rdms[column, row], rdms['whiskers', row])):+.2f}" for row in rows]
        lines.append([column, *found])
        print(*lines[-1], flush=True)
    draw(rdms, list(whiskers.labels), list(inputs), rows)
    body = (
        f"Six Rodgers stimuli (convex or concave, three distances), untrained `{options.model}`, all time steps, "
        "1 − Pearson; Pearson of the hand's dissimilarities with the whiskers' (15 pairs: |r| < .45 is chance).\n\n"
        + table(["stimuli", "input", "encoder"], lines)
    )
    publish(options, "Hand and whisker stimuli", body)


if __name__ == "__main__":
    main()
