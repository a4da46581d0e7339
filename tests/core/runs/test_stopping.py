import os
import signal
import threading

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.runs.stopping import Stop, occupied


def test_a_run_stops_after_its_time_or_at_its_count():
    assert Stop().reason(10**6) == ""
    assert Stop(0.0).reason() == "the 0 s allowed are over; start it again to go on"
    counted = Stop(count=3, counted="iterations")
    assert [bool(counted.reason(done)) for done in (2, 3)] == [False, True]
    with pytest.raises(UsageError, match="stop_after must be a finite number, at least 0; received nan"):
        Stop(float("nan"))


def test_sigterm_asks_a_run_to_stop_and_means_the_end_again_afterwards(tmp_path):
    before, stop = signal.getsignal(signal.SIGTERM), Stop()
    with occupied(tmp_path, stop):
        os.kill(os.getpid(), signal.SIGTERM)
        assert "SIGTERM" in stop.reason()
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_in_another_thread_listens_to_no_signal(tmp_path):
    before, seen = signal.getsignal(signal.SIGTERM), []

    def run():
        with occupied(tmp_path, Stop()):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [before]


def test_a_folder_has_one_run_at_a_time(tmp_path):
    with occupied(tmp_path, Stop()), pytest.raises(UsageError, match="Another process"), occupied(tmp_path, Stop()):
        pass
