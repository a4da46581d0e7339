"""The control loop ahead of other threads."""

from __future__ import annotations

import gc
import os

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.timing import PRIORITY, realtime

linux = pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="SCHED_FIFO is Linux's")


@linux
def test_a_thread_goes_ahead_and_comes_back_also_after_an_error() -> None:
    try:
        with realtime():
            assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
            assert os.sched_getparam(0).sched_priority == PRIORITY
            assert not gc.isenabled()
            raise KeyError
    except KeyError:
        pass
    except UsageError as error:
        pytest.skip(str(error))
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    assert gc.isenabled()


@linux
def test_a_user_who_may_not_is_told_how_to_be_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(UsageError, match=r"rtprio 20' in .*limits\.conf"), realtime():
        pass
    assert gc.isenabled()


def test_other_systems_are_told_that_they_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "SCHED_FIFO", raising=False)
    with pytest.raises(UsageError, match="Linux's"), realtime():
        pass
