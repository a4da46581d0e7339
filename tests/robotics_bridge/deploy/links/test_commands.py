"""``brainbench tactile replay`` as a user runs it."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd

from robotics_bridge import hands
from tests.robotics_bridge.hands.test_grippers import JAWS, LINK, URDF


def test_replay_shows_real_beside_simulated_readings_and_writes_both(run, tmp_path) -> None:
    jaws, log = tmp_path / "jaws.urdf", tmp_path / "log.csv"
    jaws.write_text(URDF.format(links="".join(LINK.format(*jaw) for jaw in JAWS)))
    joints = hands.load(jaws).joints
    closing = np.linspace(0.03, 0.0, 10)[:, None].repeat(len(joints), axis=1)
    columns = ["time", *joints, "left:0", "right:1"]
    pd.DataFrame(np.c_[np.arange(10) / 50, closing, np.ones((10, 2))], columns=columns).to_csv(log, index=False)
    arguments = ("tactile", "replay", str(log), "--hand", str(jaws))
    outcome = run(*arguments, "--out", str(tmp_path / "both.csv"))
    assert outcome.status == 0, outcome.err
    assert "left:0" in outcome.out
    both = pd.read_csv(tmp_path / "both.csv")
    assert list(both.columns) == ["time", "left:0 real", "left:0 simulated", "right:1 real", "right:1 simulated"]
    assert (both["left:0 real"] == 1).all()
    data = json.loads(run(*arguments, "--json").out)
    assert (data["hand"], data["frames"], data["joints"]) == ("jaws", 10, [*joints])
    assert [row["taxel"] for row in data["taxels"]] == ["left:0", "right:1"]
    assert run(*arguments, "--episode", "3").status == 0
    assert run("tactile", "replay", str(log), "--hand", "xhand1").status == 1
