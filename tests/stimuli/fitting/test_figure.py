"""A fit is drawn."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.mark.parametrize("kind", ["pulled", "traced"])
def test_a_fit_is_drawn(request, tmp_path, kind):
    from PIL import Image

    from brainbench.stimuli.fitting.figure import draw_fit

    path = draw_fit(*request.getfixturevalue(kind), tmp_path / "fit.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    # The colour of the first series is on it, and most of it is white.
    assert (np.abs(pixels.astype(int) - [0, 114, 178]).sum(axis=1) < 40).sum() > 50
    assert 0.5 < np.mean(pixels.min(axis=1) > 250) < 0.99
