"""Animals and models with a known geometry, and names that rsatoolbox has for comparisons of their RDMs."""

from __future__ import annotations

import numpy as np

from brainbench.core.contracts import Trials
from brainbench.metrics import rdm
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm

STIMULI = ("convex-close", "convex-medium", "convex-far", "concave-close", "concave-medium", "concave-far")


def make_latent(seed=0, stimuli=6):
    return np.random.default_rng(seed).normal(size=(stimuli, 4))


def make_block(latent, seed=0, units=20, repeats=8, noise=1.0, keys=True, gap=()):
    """One session: units with random tuning to the latent stimuli, trials with unit noise."""
    rng = np.random.default_rng(seed)
    means = latent @ rng.normal(size=(latent.shape[1], units))
    labels = rng.permutation(np.repeat([k for k in range(len(latent)) if k not in gap], repeats))
    responses = means[labels] + noise * rng.normal(size=(len(labels), units))
    return Trials(responses, labels, [f"{seed}/{trial}" for trial in range(len(labels))] if keys else None)


def make_subject(name, brain_rdm, reliability=0.9, splits=20, seed=0, **extra):
    """An animal with a given RDM and split halves that agree by a given reliability."""
    rng = np.random.default_rng(seed)
    half = reliability / (2 - reliability)
    r = half + 0.02 * rng.normal(size=splits)
    halves = np.stack([np.stack([brain_rdm, brain_rdm]) + 0.05 * rng.normal(size=(2, len(brain_rdm))) for _ in r])
    found = float(spearman_brown(r.mean()))
    return SubjectRDM(name, brain_rdm, r - r.mean() + half, halves, 10, 60, reliability=found, **extra)


def make_rdm(rng, stimuli=6):
    """The RDM of unrelated patterns."""
    return rdm(rng.normal(size=(stimuli, 12)))


def make_animals(latent, count=6, noise=2.0):
    """Animals whose units are tuned at random to one latent geometry."""
    return [
        subject_rdm(f"m{i}", [make_block(latent, seed=100 + i, noise=noise)], len(latent), splits=60)
        for i in range(count)
    ]


def make_layers(latent, count=4):
    """RDMs of layers, each nearer to the latent geometry than the one before."""
    rng = np.random.default_rng(50)
    return {f"conv{i}": rdm(np.c_[latent * i, rng.normal(size=(len(latent), 6))]) for i in range(count)}


def score_of(layers, subjects, **options):
    """The score of a model of such layers."""
    return score_rdms(layers, subjects, name="model", stimuli=STIMULI, **options)


THEIRS = {
    "pearson": "corr",
    "spearman": "spearman",
    "rho-a": "rho-a",
    "tau-a": "tau-a",
    "tau-b": "tau-b",
    "cosine": "cosine",
    "whitened-cosine": "cosine_cov",
    "whitened-pearson": "corr_cov",
}
