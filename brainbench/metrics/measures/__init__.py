"""The registered metrics: RSA (with CKA as a case of it), Procrustes, ridge encoding, decoding and partial RSA.

``registry`` says what a metric is; ``patterns`` is the base of those that compare a model's features with animals'
mean responses (``animal_patterns``). Ours are registered here, in the order in which they are listed.
"""

from __future__ import annotations

from brainbench.metrics.measures.decoding import LabelDecoding
from brainbench.metrics.measures.nuisance import PartialRSA
from brainbench.metrics.measures.procrustes import Procrustes
from brainbench.metrics.measures.registry import register_metric
from brainbench.metrics.measures.ridge import RidgeEncoding
from brainbench.metrics.measures.rsa import RSA

for metric in (
    RSA("rsa", "correlation between RDMs of correlation distances, noise-corrected"),
    # Linear CKA is the cosine of doubly centred second-moment matrices, which is what whitening makes of
    # squared Euclidean RDMs (Diedrichsen 2021, section on CKA).
    RSA("cka", "linear centred kernel alignment, noise-corrected", "sqeuclidean", "sqeuclidean", "whitened-cosine"),
    LabelDecoding(),
    Procrustes(),
    RidgeEncoding(),
    RSA(
        "rsa-crossnobis",
        "whitened cosine between RDMs, crossnobis for animals (no bias by trial noise), noise-corrected",
        "crossnobis",
        "sqeuclidean",
        "whitened-cosine",
    ),
    PartialRSA(),
):
    register_metric(metric)
