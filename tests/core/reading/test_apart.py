"""Files that are read in a process of their own."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading import apart
from brainbench.core.reading.apart import read_apart

IMPORTED_BY = os.getpid()


def imports(path):
    return {"process": np.array([IMPORTED_BY, os.getpid(), os.getppid()])}


def whole(path):
    return {"size": np.array(Path(path).stat().st_size), "words": np.array(["a", "b"])}


def crash(path):
    os.abort()


def refuse(path):
    raise DataError("This is no track.")


def fail(path):
    raise ValueError("bad magic")


def hang(path):
    while True:
        pass


def rest(path):
    time.sleep(2)
    return whole(path)


def objects(path):
    return {"code": np.array([print], dtype=object)}


@pytest.fixture
def read(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"abc")
    return lambda function: read_apart(f"{__name__}:{function.__name__}", tmp_path / "file", "track")


def test_arrays_come_back(read):
    arrays = read(whole)
    assert arrays["size"] == 3
    assert arrays["words"].tolist() == ["a", "b"]


def test_what_reads_files_is_imported_once_for_all_of_them(read):
    imported, first, parent = read(imports)["process"].tolist()
    assert imported == parent != first
    again = read(imports)["process"].tolist()
    assert again[0] == imported
    assert again[1] != first


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (crash, "is damaged: the library that reads it crashed or did not come back"),
        (refuse, "This is no track."),
        (fail, "not a readable file .*ValueError: bad magic"),
        (objects, "Python objects"),
    ],
)
def test_failures_are_one_sentence(read, function, sentence):
    with pytest.raises(DataError, match=sentence):
        read(function)


def test_what_never_ends_is_ended(read, monkeypatch):
    monkeypatch.setattr(apart, "SECONDS", 1.5)
    with pytest.raises(DataError, match="crashed or did not come back"):
        read(hang)


def test_a_machine_that_stands_still_is_no_fault_of_the_file(read, monkeypatch):
    monkeypatch.setattr(apart, "SECONDS", 1.0)
    assert read(rest)["size"] == 3


def test_what_waits_for_ever_is_ended(read, monkeypatch):
    monkeypatch.setattr(apart, "SECONDS", 0.5)
    monkeypatch.setattr(apart, "PATIENCE", 0.5)
    with pytest.raises(DataError, match="crashed or did not come back"):
        read(rest)


@pytest.fixture
def interrupted():
    """Call a function that Ctrl-C interrupts after so many seconds."""

    def stop(*_):
        raise KeyboardInterrupt

    def call(seconds, function, *arguments):
        signal.setitimer(signal.ITIMER_REAL, seconds)
        with pytest.raises(KeyboardInterrupt):
            function(*arguments)

    before = signal.signal(signal.SIGALRM, stop)
    yield call
    signal.signal(signal.SIGALRM, before)


def test_a_reading_that_is_interrupted_leaves_no_answer_to_the_next(read, interrupted):
    read(whole)
    interrupted(0.3, read, rest)
    with pytest.raises(DataError, match="This is no track"):
        read(refuse)
    assert read(whole)["size"] == 3


def test_a_process_that_is_interrupted_while_it_starts_is_started_anew(read, interrupted):
    read(whole)
    apart._Worker.process.kill()
    apart._Worker.process.wait()
    interrupted(0.05, read, whole)
    assert read(whole)["size"] == 3
