"""What the recordings ``demo-rodgers`` are like: reliability, truth and raw input, animal by animal.

Run ``python -m benchmarks.scores.demo_geometry`` after changing the stimuli or the demo's neurons. Wanted:
reliable animals (.8 and more) with one harder to read, animals that agree well but not perfectly, raw
input clearly below that (.2 to .6), and measured RDMs that correlate with their truth above .9. The raw
input of the engine ``rod`` lies above what is wanted (benchmarks/RESULTS.md).

``--engines`` instead compares the stimuli of presets and engines with one another.
"""

from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from brainbench.core.trials import Trials
from brainbench.datasets import open_recordings
from brainbench.datasets.synthetic import ensure_rodgers_demo, read_truth
from brainbench.datasets.trials.session_trials import trials_by_subject
from brainbench.metrics import rdm
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.stimuli import get_recipe, load_stimuli, simulate

UNITS = np.array([1e-4] * 3 + [1e-6] * 3)
"""Newton and newton metre that count alike in the raw input."""


def correlate(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Pearson correlation of two RDMs."""
    return float(np.corrcoef(first, second)[0, 1])


def compare_engines() -> None:
    """Print a table of how much the forces and RDMs of several settings differ."""
    found = {}
    for backend, preset in (("rod", "fast"), ("rod", "balanced"), ("rod", "accurate"), ("mujoco", "balanced")):
        dataset = load_stimuli("rodgers", backend=backend, fidelity=preset).dataset
        assert dataset is not None
        found[f"{backend}, {preset}"] = dataset["wrench"].values.astype(float) / UNITS
    print("| of | against | forces and moments, rms | RDM, mean over steps | RDM, all frames |")
    print("|---|---|---|---|---|")
    for one, other in combinations(found, 2):
        a, b = found[one], found[other]
        gap = np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2))
        mean, whole = (
            correlate(rdm(view(a)), rdm(view(b)))
            for view in (lambda x: x.reshape(6, 22, -1).mean(axis=1), lambda x: x.reshape(6, -1))
        )
        print(f"| {one} | {other} | {gap:.1%} | {mean:.3f} | {whole:.3f} |")


def main() -> None:
    """Print one line per animal and the agreement between animals."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--engines", action="store_true", help="compare presets and engines")
    if parser.parse_args().engines:
        compare_engines()
        return
    stimuli = simulate(get_recipe("rodgers").scenes)
    folder = ensure_rodgers_demo(stimuli)
    truth = read_truth(folder)
    order = [list(map(str, stimuli["stimulus"].values)).index(label) for label in truth["labels"]]
    wrench = stimuli["wrench"].values[order].astype(float) / UNITS
    raw = {
        "mean over steps": rdm(wrench.reshape(6, 22, -1).mean(axis=1)),
        "all frames": rdm(wrench.reshape(6, -1)),
    }
    labels = truth["labels"]
    animals = []
    for name, sessions in trials_by_subject(open_recordings(folder)).items():
        trials = [Trials(item.responses[:, 0], item.labels, item.keys) for item in sessions]
        animals.append(subject_rdm(name, trials, len(labels)))
    print(f"{'animal':8} {'reliability':>11} {'own truth':>9} {'shared':>6}", *(f"{name:>16}" for name in raw))
    for animal in animals:
        own = correlate(animal.rdm, truth["subjects"][animal.subject])
        line = f"{animal.subject:8} {animal.reliability:11.2f} {own:9.2f} {correlate(animal.rdm, truth['shared']):6.2f}"
        print(line, *(f"{correlate(animal.rdm, values):16.2f}" for values in raw.values()))
    against = ", ".join(f"{name} {correlate(values, truth['shared']):.2f}" for name, values in raw.items())
    print(f"raw input with the shared truth: {against}")
    print(RSA(comparison="pearson").score_animals(animals, stimuli=labels).summary())


if __name__ == "__main__":
    main()
