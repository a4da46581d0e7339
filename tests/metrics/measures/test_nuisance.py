"""Nuisance RDMs and the partition of variance."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics.measures.nuisance import variance_partition
from tests.factories.animals import make_rdm


def _r2(y, *x):
    design = np.column_stack([np.ones(len(y)), *x])
    rest = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return 1 - rest @ rest / ((y - y.mean()) @ (y - y.mean()))


def test_the_parts_are_differences_of_r_squared_and_add_up():
    rng = np.random.default_rng(0)
    model, one, two = (make_rdm(rng) for _ in range(3))
    brain = np.stack([model + one + 0.3 * make_rdm(rng) for _ in range(3)])
    found = variance_partition(model, {"contacts": one, "licks": two}, brain)
    full = np.mean([_r2(y, model, one, two) for y in brain])
    nuisance = np.mean([_r2(y, one, two) for y in brain])
    alone = np.mean([_r2(y, model) for y in brain])
    assert found.total == pytest.approx(full)
    assert found.unique_model == pytest.approx(full - nuisance)
    assert found.unique_nuisance == pytest.approx(full - alone)
    assert found.unique_model + found.unique_nuisance + found.shared == pytest.approx(found.total)
    assert found.nuisances == ("contacts", "licks")


def test_a_model_that_is_only_the_nuisance_has_no_unique_share():
    rng = np.random.default_rng(1)
    contacts = make_rdm(rng)
    brain = np.stack([contacts + 0.1 * make_rdm(rng) for _ in range(4)])
    copied = variance_partition(contacts + 0.05 * make_rdm(rng), {"contacts": contacts}, brain)
    assert copied.unique_model < 0.1
    assert copied.p > 0.05
    assert copied.shared > 0.8
    geometry = make_rdm(rng)
    true = variance_partition(geometry, {"contacts": contacts}, brain + 2 * geometry)
    assert true.p <= 0.01
    assert true.partial_r > 0.9
    assert true.unique_model > true.chance


def test_p_values_of_unrelated_models_are_uniform():
    rng = np.random.default_rng(2)
    p = []
    for _ in range(200):
        nuisance, model = make_rdm(rng), make_rdm(rng)
        p.append(variance_partition(model, {"n": nuisance}, nuisance + make_rdm(rng)).p)
    assert 0.01 <= np.mean(np.array(p) <= 0.05) <= 0.1
    assert np.mean(p) == pytest.approx(0.5, abs=0.07)


def test_misuse_is_told_in_a_sentence():
    rng = np.random.default_rng(3)
    model = make_rdm(rng)
    with pytest.raises(UsageError, match="no nuisances"):
        variance_partition(model, {}, model)
    with pytest.raises(DataError, match="missing pairs"):
        variance_partition(model, {"a": np.full(15, np.nan)}, model)
    with pytest.raises(DataError, match="too few to fit 4 nuisances"):
        variance_partition(model[:6], {str(i): model[:6] for i in range(4)}, model[:6])
    with pytest.raises(UsageError, match="different numbers of stimuli"):
        variance_partition(model[:10], {"a": model}, model)
    few = variance_partition(model, {"a": model}, make_rdm(rng))
    assert np.isnan(few.p)
    assert "no more than the nuisances explain" in few.reason
