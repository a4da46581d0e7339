"""Results of fits: combinations that the data tell, and a summary for JSON."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.stimuli.fitting.result import directions, unknown_parameters


def test_a_product_that_the_data_tell_leaves_its_factors_open():
    """Data that depend on E r⁴ alone: E × 1.1 is made up for by r × 1.1^(−1/4)."""
    column = np.linspace(1, 2, 30)[:, None] * 50
    found = directions(column * np.array([[1.0, 4.0]]), ("young_modulus", "base_radius"))
    assert [one.identified for one in found] == [False, True]
    assert "young_modulus × 1.1 together with base_radius × 0.976" in found[0].words
    assert set(unknown_parameters(found)) == {"young_modulus", "base_radius"}
    assert math.isinf(found[0].deviation)


def test_a_parameter_without_effect_is_named_alone():
    jacobian = np.stack([np.full(20, 30.0), np.full(20, 1e-9), np.linspace(-30, 30, 20)], axis=1)
    found = directions(jacobian, ("young_modulus", "friction", "object_x"))
    assert found[0].words == "The data hardly depend on friction."
    assert set(unknown_parameters(found)) == {"friction"}


def test_the_summary_is_plain(traced):
    import json

    from brainbench.core.files import to_json

    data = json.loads(to_json(traced[1].summary()))
    assert data["status"] == "undefined"
    assert data["directions"][0]["deviation"] is None or data["directions"][0]["deviation"] > 1
    assert data["provenance"]["simulated_whiskers"] > 5


@pytest.mark.parametrize("kind", ["pulled", "traced"])
def test_a_fit_is_drawn(request, tmp_path, kind):
    from PIL import Image

    from brainbench.stimuli.fitting.result import draw_fit

    path = draw_fit(*request.getfixturevalue(kind), tmp_path / "fit.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    # The colour of the first series is on it, and most of it is white.
    assert (np.abs(pixels.astype(int) - [0, 114, 178]).sum(axis=1) < 40).sum() > 50
    assert 0.5 < np.mean(pixels.min(axis=1) > 250) < 0.99
