"""A cache for the tests of this folder alone."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def own_cache(tmp_path_factory):
    """An empty cache, also where the tests share one between runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BRAINBENCH_CACHE", str(tmp_path_factory.mktemp("collision")))
        yield
