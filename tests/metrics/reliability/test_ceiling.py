"""Noise ceilings against rsatoolbox."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import noise_ceiling
from brainbench.metrics.rdms.comparison import COMPARISONS
from tests.factories.rsatoolbox_names import THEIRS


def _make_animals(count=7, seed=0):
    rng = np.random.default_rng(seed)
    return rng.gamma(3.0, size=15) + 0.5 * rng.gamma(2.0, size=(count, 15))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("method", COMPARISONS)
def test_ceilings_equal_rsatoolbox(method, missing):
    rsa = pytest.importorskip("rsatoolbox.rdm")
    from rsatoolbox.inference.noise_ceiling import boot_noise_ceiling

    animals = _make_animals()
    if missing:
        animals[:, 4] = np.nan
    expected = boot_noise_ceiling(rsa.RDMs(animals), method=THEIRS[method])
    # With missing pairs rsatoolbox' whitening is the closed form of complete RDMs, an approximation.
    tolerance = 0.02 if missing and "whitened" in method else 1e-10
    np.testing.assert_allclose(noise_ceiling(animals, method=method), expected, atol=tolerance)


def test_a_pair_missing_in_one_animal_is_left_out_for_all():
    animals = _make_animals()
    everywhere = animals.copy()
    animals[2, 4] = np.nan
    everywhere[:, 4] = np.nan
    np.testing.assert_allclose(noise_ceiling(animals), noise_ceiling(everywhere), atol=1e-13)


def test_the_ceiling_brackets_the_true_geometry():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(60):
        truth = rng.normal(size=15)
        animals = truth + 0.7 * rng.normal(size=(8, 15))
        lower, upper = noise_ceiling(animals)
        r = np.mean([np.corrcoef(truth, animal)[0, 1] for animal in animals])
        inside.append((lower < r, r < upper))
    assert np.mean(inside, axis=0).min() > 0.9


def test_one_animal_has_no_ceiling_and_says_why():
    found = noise_ceiling(_make_animals(1))
    lower, upper = found
    assert np.isnan([lower, upper]).all()
    assert "at least two animals" in found.reason
    assert noise_ceiling(_make_animals(2)).reason == ""


def test_the_order_of_animals_is_irrelevant():
    animals = _make_animals()
    np.testing.assert_allclose(noise_ceiling(animals[::-1]), noise_ceiling(animals), atol=1e-13)


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match=r"all animals \[A, P\]"):
        noise_ceiling(np.ones(15))
    with pytest.raises(UsageError, match="Unknown RDM comparison"):
        noise_ceiling(_make_animals(), method="corr")
