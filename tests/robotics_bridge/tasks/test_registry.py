"""Numbers of a task changed by words, as commands take them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.task import ObjectRandomisation

TASK = tasks.load("in_palm_rotate")


def test_words_reach_rewards_their_parameters_endings_learning_and_the_task() -> None:
    new = apply_overrides(
        TASK,
        [
            "is_dropped=-300", "rotation_progress.clip=2", "obj_dist_penalty.target=0,0,0.51", "obj_dropped.height=.44",
            "reached_max_consecutive_successes.count=3", "entropy=0", "epochs=3", "schedule=fixed",
            "learning_rate_range=1e-4,1e-3", "episode=15", "goal.start_threshold=0.3", "push.interval=1,2",
        ],
    )  # fmt: skip
    assert new.rewards["is_dropped"].weight == -300
    assert new.rewards["rotation_progress"].params == {"clip": 2.0, "penalty_scale": 1.0}
    assert new.rewards["obj_dist_penalty"].params["target"] == (0.0, 0.0, 0.51)
    assert new.endings["obj_dropped"].params["height"] == 0.44
    assert new.endings["reached_max_consecutive_successes"].params["count"] == 3
    assert (new.teacher.entropy, new.teacher.epochs, new.teacher.schedule) == (0.0, 3, "fixed")
    assert new.teacher.learning_rate_range == (1e-4, 1e-3)
    assert new.goal is not None
    assert new.push is not None
    assert (new.episode, new.goal.start_threshold, new.push.interval) == (15.0, 0.3, (1.0, 2.0))
    assert apply_overrides(new, ["goal.start_threshold=0.4"]).goal == TASK.goal
    none = apply_overrides(new, ["goal.start_threshold=none"]).goal
    assert none is not None
    assert none.start_threshold is None
    mixed = apply_overrides(TASK, ["objects=cylinder,box,cylinder"]).objects
    assert [shape.name.partition(" ")[0] for shape in mixed] == ["cylinder"] * 2 + ["box"] * 15 + ["cylinder"] * 2
    # What no word names stays.
    assert new.rewards["work_penalty"] is TASK.rewards["work_penalty"]
    assert TASK.rewards["is_dropped"].weight == -100


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("is_droped=-3", "did you mean 'is_dropped'"),
        ("is_dropped", "name=value"),
        ("rotation_progress.clp=3", "did you mean 'clip'"),
        ("entropy=much", r"'entropy' .*0\.002; received 'much'"),
        ("epochs=2.5", r"'epochs' .*5; received '2\.5'"),
        ("objects=cilinder", "did you mean 'cylinder'"),
        ("goal.thresh=0.3", "did you mean 'threshold'"),
        ("episode.long=3", "'episode' has no parts"),
        ("goal=3", "dataclasses.replace"),
        ("goal.start_threshold=0.05", "wider threshold than 0.1 rad"),
        ("goal.narrowing=1.5", "above 0 and below 1; received 1.5"),
        ("schedule=adptive", "did you mean 'adaptive'"),
        ("learning_rate_range=1e-2,1e-3", "is a range"),
    ],
)
def test_words_that_name_nothing_or_hold_no_such_value_are_refused(word: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        apply_overrides(TASK, [word])


def test_a_number_is_changed_once() -> None:
    with pytest.raises(UsageError, match="'episode' more than once"):
        apply_overrides(TASK, ["episode=15", "entropy=0", "episode=20"])


MY_TASK = """
from dataclasses import replace
from robotics_bridge import tasks
from robotics_bridge.tasks import terms

@tasks.register("keep_still")
def keep_still() -> tasks.Task:
    rotate = tasks.load("in_palm_rotate")
    rewards = {"stay": tasks.Reward(-10.0, terms.far_from, {"target": None, "margin": 0.0})}
    return replace(rotate, name="keep_still", text="hold a block still", rewards=rewards, goal=None, goal_terms=(),
                   endings={}, auxiliary=(), decoders=(),
                   groups={"actor": ("priv_proprio", "priv_obj_state"), "student": ("proprio",)})
"""


def test_a_task_of_ones_own_is_one_file(tmp_path: Path) -> None:
    from brainbench.core.plugins import load_module

    file = tmp_path / "keep_still.py"
    file.write_text(MY_TASK)
    load_module(str(file))
    try:
        assert "keep_still" in tasks.list_tasks()
        env = tasks.make("keep_still", num_envs=2, threads=1)
        observations, reward, *_ = env.step(torch.zeros(2, env.num_actions))
        assert set(observations) == {"proprio", "priv_proprio", "priv_obj_state"}
        assert (reward <= 0).all()
        with pytest.raises(UsageError, match="already"):
            load_module(str(file))
    finally:
        tasks.forget("keep_still")
    assert "keep_still" not in tasks.list_tasks()


def test_unknown_names_are_met_with_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'screwdriver'"):
        tasks.load("screwdrivr")
    with pytest.raises(UsageError, match="did you mean 'published'"):
        tasks.load("screwdriver", "publish")
    with pytest.raises(UsageError, match="'priv_obj_stat'; did you mean"):
        replace(tasks.load("screwdriver"), groups={"actor": ("priv_obj_stat",)})
    with pytest.raises(UsageError, match=r"episode of a task .*received 0"):
        replace(tasks.load("screwdriver"), episode=0.0)
    with pytest.raises(UsageError, match="range"):
        replace(tasks.load("screwdriver"), object_changes=ObjectRandomisation(friction=(2.0, 1.0)))
