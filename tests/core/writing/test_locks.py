"""Locks on folders."""

import subprocess
import sys

import pytest

from brainbench.core.writing.locks import lock_folder


def test_a_locked_folder_is_refused_or_waited_for(tmp_path):
    code = (
        "import pathlib, sys; from brainbench.core.writing.locks import lock_folder\n"
        "with lock_folder(pathlib.Path(sys.argv[1]), wait=sys.argv[2] == 'wait') as held: print(held)"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    with lock_folder(tmp_path) as held:
        assert held
        refused = subprocess.run([*words, "refuse"], capture_output=True, text=True, check=False)
        assert (refused.returncode, tmp_path.name in refused.stderr) == (1, True)
        waiting = subprocess.Popen([*words, "wait"], stdout=subprocess.PIPE, text=True)
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.wait(2)
    assert waiting.communicate(timeout=30)[0] == "True\n"
