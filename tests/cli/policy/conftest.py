from __future__ import annotations

from pathlib import Path

import pytest

SMALL = """
from dataclasses import replace
from robotics_bridge import tasks

@tasks.register("quick")
def quick() -> tasks.Task:
    task = tasks.load("in_palm_rotate")
    return replace(task, name="quick", episode=0.1,
                   teacher=replace(task.teacher, hidden=(8,), epochs=1, minibatches=1, steps_per_env=4))
"""


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    from robotics_bridge import tasks

    file = tmp_path / "quick.py"
    file.write_text(SMALL)
    if "quick" in tasks.list_tasks():
        tasks.forget("quick")
    return file
