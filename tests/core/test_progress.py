import subprocess
import sys

from brainbench.core.progress import stages, track


def test_ctrl_c_does_not_wait_for_a_compiler_in_a_thread():
    code = """
import threading, time
import brainbench.cli as cli
from brainbench.core.progress import PREPARATION

def interrupted():
    threading.Thread(target=time.sleep, args=(60,), name=PREPARATION).start()
    raise KeyboardInterrupt

cli._run = interrupted
cli.main()
"""
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 130
    assert "same command" in done.stderr


def test_items_are_told_before_each_and_at_the_end():
    told = []
    items = track("ab", "reading", lambda *said: told.append(said))
    assert (next(items), told) == ("a", [(0, 2, "reading")])
    assert (list(items), told[1:]) == (["b"], [(1, 2, "reading"), (2, 2, "reading")])
    assert list(track("ab", "reading", None)) == ["a", "b"]


def test_stages_are_counted_from_the_beginning():
    told = []
    stage_done = stages(2, "fitting", lambda *said: told.append(said))
    assert told == [(0, 2, "fitting")]
    stage_done()
    stage_done()
    assert told[1:] == [(1, 2, "fitting"), (2, 2, "fitting")]
