import pytest

import brainbench


def test_the_public_names_resolve():
    for name in brainbench.__all__:
        assert getattr(brainbench, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'scoer'"):
        _ = brainbench.scoer
