import doctest

import pytest

from brainbench.core import errors


def test_examples_in_the_docstrings_hold():
    result = doctest.testmod(errors)
    assert result.attempted > 0
    assert result.failed == 0


def test_a_far_off_name_gets_no_wild_guess():
    assert errors.nearest("qqqq", ["zhuang", "resnet18"]) is None
    assert "did you mean" not in str(errors.unknown_name("model", "qqqq", ["zhuang"]))


def test_the_nearest_name_ignores_case_and_returns_the_allowed_spelling():
    assert errors.nearest("uggrnn", ["UGRNN", "LSTM"]) == "UGRNN"


def test_a_missing_package_names_the_extra_that_installs_it():
    error = errors.missing_dependency("pynwb", extra="nwb", purpose="Checking a file")
    assert "pip install -c constraints.txt '.[nwb]'" in str(error)
    assert isinstance(error, ImportError)


@pytest.mark.parametrize(
    ("kind", "status"),
    [
        (errors.UsageError, 2),
        (errors.DataFileNotFoundError, 2),
        (errors.DataError, 1),
        (errors.MissingDependencyError, 1),
    ],
)
def test_exit_status_tells_a_wrong_request_from_a_failed_job(kind: type[errors.BrainbenchError], status: int):
    assert kind.exit_code == status
