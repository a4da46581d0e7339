"""The registered metrics: RSA, CKA, Procrustes, ridge encoding, matched units, decoding and partial RSA.

``metric`` says what a metric is and finds one by name; ``patterns`` has the base of those that compare a model's
features with animals' mean responses. Ours are registered here, in the order in which they are listed.
"""

from __future__ import annotations

from brainbench.metrics.measures.decoding import LabelDecoding
from brainbench.metrics.measures.metric import register_metric
from brainbench.metrics.measures.patterns import (
    LinearCKA,
    OneToOne,
    PartialRSA,
    Procrustes,
    RidgeEncoding,
    SoftMatching,
)
from brainbench.metrics.measures.rsa import RSA

for measure in (
    # Squared Euclidean RDMs by whitened cosine is linear CKA (Diedrichsen 2021), here with the noise of trials taken
    # out of the animals' distances.
    RSA("rsa", "whitened cosine between RDMs of squared Euclidean distances, without trial noise, noise-corrected"),
    RSA(
        "rsa-correlation",
        "correlation between RDMs of correlation distances, noise-corrected (as in the published work)",
        "correlation",
        "none",
        "correlation",
        "pearson",
        splits=1000,
    ),
    LinearCKA(),
    LabelDecoding(),
    Procrustes(),
    RidgeEncoding(),
    RSA(
        "rsa-crossnobis",
        "whitened cosine between RDMs, the animals' distances divided by each unit's noise, noise-corrected",
        noise="diag",
    ),
    PartialRSA(),
    SoftMatching(),
    OneToOne(),
):
    register_metric(measure)
