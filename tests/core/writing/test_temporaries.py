import subprocess
import sys
from pathlib import Path

from brainbench.core.files import write_text
from brainbench.core.writing.temporaries import temporary_path

KILLED = """
import os, signal, sys
from pathlib import Path
from brainbench.core.writing.temporaries import temporary_path
left = temporary_path(Path(sys.argv[1]) / "x.json")
left.write_text("{ half")
folder = temporary_path(Path(sys.argv[1]) / "run")
(folder / "inner").mkdir(parents=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_goes_with_the_next_file_written_there(tmp_path: Path):
    (tmp_path / ".notes-0123456789abcdef.txt").write_text("somebody's own")
    mine = temporary_path(tmp_path / "mine.json")
    mine.write_text("being written")
    subprocess.run([sys.executable, "-c", KILLED, tmp_path], check=False)
    assert len(list(tmp_path.iterdir())) == 4
    subprocess.run(
        [
            sys.executable,
            "-c",
            f"from brainbench.core.files import write_text; write_text({str(tmp_path / 'y')!r}, 'y')",
        ],
        check=True,
    )
    assert {path.name for path in tmp_path.iterdir()} == {".notes-0123456789abcdef.txt", mine.name, "y"}


def test_a_long_name_leaves_room_for_the_token(tmp_path: Path):
    write_text(tmp_path / ("n" * 240 + ".json"), "x")
    assert [path.name for path in tmp_path.iterdir()] == ["n" * 240 + ".json"]
