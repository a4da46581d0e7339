"""Numbers of a task changed by words, as commands take them."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.tasks.registry import apply_overrides

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
