import subprocess
import sys


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
