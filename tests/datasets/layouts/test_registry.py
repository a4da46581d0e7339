from __future__ import annotations

import logging
import sys

import numpy as np
import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from brainbench.datasets import (
    RecordingLayout,
    fetch,
    open_recordings,
    register_layout,
    write_recordings,
)
from brainbench.datasets.layouts.registry import get_layout, list_layouts
from brainbench.datasets.trials.selection import Conditions, Selection, Window
from tests.factories.recordings import make_simple_session

# A layout of one's own


def my_layout(name="my-lab", **changes):
    return RecordingLayout(
        name=name,
        title="my experiment",
        citation="me",
        conditions=Conditions("trials", ("stimulus",)),
        orders={"stimulus": ("c", "b", "a")},
        selection=Selection(),
        window=Window("start", length=0.5),
        columns=("stimulus", "mine"),
        **changes,
    )


@pytest.fixture
def registry(monkeypatch):
    from brainbench.datasets.layouts import registry as layouts

    monkeypatch.setattr(layouts, "_LAYOUTS", dict(layouts._LAYOUTS))


def test_a_registered_layout_is_found_by_name_and_by_layout(registry, tmp_path):
    assert register_layout(my_layout()) == my_layout()
    assert "my-lab" in list_layouts()
    path = write_recordings(tmp_path / "a.h5", make_simple_session(columns={"mine": np.ones(12)}))
    dataset = open_recordings(path)
    assert dataset.attrs["layout"] == "my-lab (detected from its columns)"
    assert dataset.attrs["vocabulary"] == ["c", "b", "a"]
    other = write_recordings(tmp_path / "b.h5", make_simple_session())
    assert open_recordings(f"my-lab:{other}").attrs["window"] == "start..+0.5"
    with pytest.raises(UsageError, match="layout 'my-lab'"):
        register_layout(my_layout(remarks=("other",)))
    with pytest.raises(UsageError, match="received 'c'"):
        register_layout(my_layout("c"))


@pytest.mark.parametrize("constant", ["LAYOUT", "RECIPE"])
def test_a_layout_in_a_file_of_its_own_works_on_the_command_line(registry, tmp_path, constant):
    """The example of docs/recordings.md."""
    import re
    from pathlib import Path

    page = (Path(__file__).parents[3] / "docs" / "recordings.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```py\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "my_lab.py").write_text(example.replace("LAYOUT =", f"{constant} ="))
    columns = {"texture": np.resize(np.array(["rough", "smooth", "none"]), 12)}
    path = write_recordings(tmp_path / "a.h5", make_simple_session(columns=columns))
    dataset = open_recordings(f"{tmp_path / 'my_lab.py'}:{path}")
    assert dataset.attrs["layout"] == "my-lab"
    assert dataset.attrs["vocabulary"] == ["smooth", "rough"]
    assert dataset.attrs["removed"]["trials: label outside the vocabulary"] == 4


@pytest.mark.parametrize(
    ("content", "message"),
    [("x = 1", r"defines no LAYOUT"), ("raise KeyError('k')", r"KeyError: 'k'"), (None, "There is no Python file")],
)
def test_an_unusable_layout_file_is_refused_in_words(registry, tmp_path, content, message):
    if content:
        (tmp_path / "my.py").write_text(content)
    with pytest.raises((UsageError, DataError), match=message):
        open_recordings(f"{tmp_path / 'my.py'}:a.h5")


def test_installed_packages_add_layouts_and_one_that_fails_takes_nothing_away(registry, monkeypatch, tmp_path, caplog):
    (tmp_path / "their_recordings.py").write_text(
        "from dataclasses import replace\n"
        "from brainbench.datasets import Conditions, RecordingLayout, Selection, Window, register_layout\n"
        "ONE = RecordingLayout('their-one', 'theirs', 'Them (2026)', Conditions('trials', ('texture',)), {}, "
        "Selection(), Window('start', length=0.5), ('texture', 'their_mark'))\n"
        "register_layout(replace(ONE, name='their-two', columns=()))\n"
    )
    (tmp_path / "broken_recordings.py").write_text("raise RuntimeError('out of order')\n")
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[brainbench.recordings]\nmine = their_recordings:ONE\nbroken = broken_recordings\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("brainbench.datasets.layouts.registry._loaded", [])
    with caplog.at_level(logging.WARNING):
        names = list_layouts()
    assert {"their-one", "their-two", "rodgers"} <= set(names)
    assert get_layout("their-one").citation == "Them (2026)"
    assert "'broken' (broken_recordings)" in caplog.text


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
