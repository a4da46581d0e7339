import sys

import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from brainbench.datasets import (
    fetch,
)

# Fetching


def test_without_the_client_nothing_is_tried(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependencyError, match=r"\[dandi\].*DANDI:000231"):
        fetch("rodgers", tmp_path / "data")
    assert not (tmp_path / "data").exists()
    with pytest.raises(UsageError, match="'rogers'; did you mean 'rodgers'"):
        fetch("rogers", tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in client is a shell script")
@pytest.mark.parametrize(
    ("name", "assets", "source"),
    [
        ("rodgers", None, "dandi://dandi/000231/*ecephys*"),
        ("000231", "sub-231CR/*", "dandi://dandi/000231/sub-231CR/*"),
        ("DANDI:000999", None, "DANDI:000999"),
    ],
)
def test_the_client_is_asked_for_the_files_with_units(monkeypatch, tmp_path, name, assets, source):
    client = tmp_path / "dandi"
    client.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\n')
    client.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    number = "000999" if "999" in source else "000231"
    assert fetch(name, tmp_path / "data", assets=assets) == tmp_path / "data" / number
    asked = (tmp_path / "asked").read_text().split()
    assert asked[0] == "download"
    assert asked[-1] == source
    assert ("glob" in asked) == ("dandi://" in source)
    client.write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(DataError, match="status 3"):
        fetch(name, tmp_path / "data", assets=assets)
