"""The teacher: one small run, killed and gone on with, and what a checkpoint holds."""

from __future__ import annotations

import csv
import json
import logging
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from brainbench.core.errors import BrainbenchError, DataError, UsageError
from brainbench.core.files import read_json, write_json
from brainbench.core.runs.folder import STATE, load_state, save_state
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.contract import trained_contacts
from robotics_bridge.policies.evaluate import Policy, evaluate
from robotics_bridge.policies.shipped import FOLDER, SENSING, newest
from robotics_bridge.policies.training.distill import load_student
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.policies.training.teacher import (
    StudentRun,
    TeacherRun,
    Trainer,
    calibrated,
    is_done,
    load_teacher,
    train_student,
)
from robotics_bridge.policies.training.teacher import train as train_teacher
from robotics_bridge.tasks.goals import SteppingRotation
from robotics_bridge.tasks.settings import CONTACTS, TeacherSettings
from robotics_bridge.tasks.task import TASK_VERSION
from tests.factories.damage import damaged, mutate
from tests.factories.policies import teacher_in
from tests.factories.task_worlds import Follower, TouchWorld

SMALL = TeacherSettings(num_envs=4, steps_per_env=6, iterations=4, epochs=2, minibatches=2, hidden=(16, 16))


def _env(seed: int = 0, **changes: Any) -> Env:
    return tasks.make(replace(tasks.load("in_palm_rotate"), **changes), num_envs=4, threads=1, seed=seed)


def train(env: Env, run: Path, *, settings: TeacherSettings, **options: Any) -> Any:
    return train_teacher(env, run, TeacherRun(**options), settings=settings)


def test_settings_become_those_of_rsl_rl() -> None:
    task = tasks.load("in_palm_rotate", "published")
    config = task.teacher.config(dict(task.groups))
    assert config["algorithm"]["rnd_cfg"]["weight"] == 100.0
    assert config["obs_groups"]["critic"] == ["goal", "priv_proprio", "priv_obj_state", "priv_obj_props"]
    assert config["actor"]["hidden_dims"] == [512, 256, 128]
    assert "rnd_cfg" not in replace(task.teacher, rnd_weight=0.0).config(dict(task.groups))["algorithm"]


def test_a_run_that_stops_halfway_goes_on_exactly(tmp_path: Path) -> None:
    whole = train(_env(), tmp_path / "whole", settings=SMALL, iterations=4, save_every=1)
    train(_env(), tmp_path / "parts", settings=SMALL, iterations=2, save_every=1)
    rest = train(_env(seed=9), tmp_path / "parts", settings=SMALL, iterations=4, save_every=1)
    assert [row["iteration"] for row in rest.history] == [3, 4]
    for one, two in zip(whole.history[2:], rest.history, strict=True):
        for name in ("reward", "loss/value", "loss/rnd", "curiosity", "std"):
            assert one[name] == two[name], name
    first, second = (load_state(newest(tmp_path / part))["actor"] for part in ("whole", "parts"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    log = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in log] == [1, 2, 3, 4]
    assert list((tmp_path / "parts" / "tensorboard").iterdir())


def test_a_run_killed_before_its_first_checkpoint_begins_its_log_anew(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1)
    (tmp_path / STATE).unlink()
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"iteration": 2, "rew')
    train(_env(), tmp_path, settings=SMALL, iterations=2)
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == [1, 2]


@pytest.mark.slow
def test_a_killed_run_goes_on_exactly(tmp_path: Path) -> None:
    text = f"""
from pathlib import Path
from tests.robotics_bridge.policies.training.test_teacher import SMALL, _env, train
train(_env(), Path({str(tmp_path / "killed")!r}), settings=SMALL, iterations=10000, save_every=1)
"""
    root = Path(__file__).parents[4]
    process = subprocess.Popen([sys.executable, "-c", text], env={**os.environ, "PYTHONPATH": str(root)})
    resume = tmp_path / "killed" / STATE
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and not (resume.is_file() and len(list(resume.parent.glob("model_*"))) > 2):
        time.sleep(0.2)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = int(load_state(resume)["iteration"])
    rest = train(_env(), tmp_path / "killed", settings=SMALL, iterations=done + 1, save_every=1)
    whole = train(_env(), tmp_path / "whole", settings=SMALL, iterations=done + 1, save_every=100)
    assert rest.history[-1]["reward"] == whole.history[-1]["reward"]
    assert rest.history[-1]["loss/value"] == whole.history[-1]["loss/value"]


def test_a_trained_actor_acts_alike_after_loading(tmp_path: Path) -> None:
    env = _env()
    train(env, tmp_path, settings=SMALL, iterations=1)
    policy = load_teacher(tmp_path, env)
    action = policy(env.observations)
    assert action.shape == (4, 5)
    assert torch.equal(action, load_teacher(newest(tmp_path), env)(env.observations))
    policy.reset(torch.ones(4, dtype=torch.bool))


def test_loading_an_actor_leaves_episodes_and_random_numbers_as_they_were(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1)
    env = _env()
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    load_teacher(tmp_path, env)
    assert torch.equal(torch.rand(2), expected)
    assert env.episode_length_buf.tolist() == [0] * 4


def test_a_run_may_begin_with_the_networks_of_another(tmp_path: Path) -> None:
    train(_env(), tmp_path / "first", settings=SMALL, iterations=2)
    env = tasks.make("in_palm_rotate", config="careful", num_envs=4, threads=1)
    settings = replace(SMALL, rnd_weight=0.0)
    trainer = Trainer(env, settings)
    trainer.begin_from(tmp_path / "first")
    given = load_state(newest(tmp_path / "first"))
    own = trainer.algorithm.save()
    for name in ("actor", "critic"):
        assert all(torch.equal(value, own[f"{name}_state_dict"][key]) for key, value in given[name].items())
    result = train(env, tmp_path / "second", settings=settings, iterations=1, start=tmp_path / "first")
    assert result.iterations == 1
    config = json.loads((tmp_path / "second" / "config.json").read_text())
    assert config["start"]["file"].endswith("first/model_2.safetensors")
    with pytest.raises(DataError, match=r"'mlp\.0\.weight' .*\[16, .*\[32"):
        Trainer(env, replace(settings, hidden=(32, 16))).begin_from(tmp_path / "first")


def test_what_a_run_begins_with_is_not_changed_before_its_first_state_nor_named_anew(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train(_env(), first, settings=SMALL, iterations=1)
    train(_env(), second, settings=SMALL, iterations=1, start=first)
    stated = json.loads((second / "config.json").read_text())["start"]["hash"]
    for changes in ({"start": first, "start_std": 0.3}, {"start": second}):
        with pytest.raises(UsageError, match=r"holds another run: start\."):
            train(_env(), second, settings=SMALL, iterations=2, **changes)
    assert train(_env(), second, settings=SMALL, iterations=2).iterations == 2
    (second / STATE).unlink()
    with pytest.raises(UsageError, match=rf"start\.hash '{stated[:8]}.*now None"):
        train(_env(), second, settings=SMALL, iterations=3)


def test_exploration_may_begin_anew_with_the_networks_of_another(tmp_path: Path) -> None:
    train(_env(), tmp_path / "first", settings=SMALL, iterations=1)
    settings = replace(SMALL, std_range=(0.1, 0.5), learning_rate_range=(9e-4, 1.1e-3), entropy=10.0)
    for std, expected in ((0.25, 0.25), (3.0, 0.5)):
        trainer = Trainer(_env(), settings)
        trainer.begin_from(tmp_path / "first", std=std)
        assert trainer.algorithm.act(trainer.env.get_observations()).shape == (4, 5)
        assert trainer.algorithm.get_policy().output_std.mean().item() == pytest.approx(expected)
    for _ in range(3):
        assert 9e-4 <= trainer.iterate()["learning_rate"] <= 1.1e-3
    with pytest.raises(UsageError, match=r"start_std .*received 0\.3"):
        train(_env(), tmp_path / "second", settings=SMALL, iterations=1, start_std=0.3)


def test_a_run_of_before_a_setting_existed_goes_on(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1, save_every=1)
    config = json.loads((tmp_path / "config.json").read_text())
    del config["settings"]["std_range"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    assert train(_env(), tmp_path, settings=SMALL, iterations=2, save_every=1).iterations == 2


def test_a_run_of_another_version_of_the_tasks_does_not_go_on(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1, save_every=1)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "task_version": 1}))
    with pytest.raises(DataError, match="of version 1 of the tasks"):
        train(_env(), tmp_path, settings=SMALL, iterations=2, save_every=1)


def test_learning_begins_with_the_wide_goal_and_goes_on_with_the_one_it_reached(tmp_path: Path) -> None:
    goal = SteppingRotation(start_threshold=3.14, narrowing=0.5)
    # A threshold of almost half a turn is always met, so the first episodes to end narrow it.
    changes: dict[str, Any] = {"goal": goal, "episode": 0.2}
    whole = train(_env(**changes), tmp_path / "whole", settings=SMALL, iterations=4, save_every=1)
    found = [row["threshold"] for row in whole.history]
    assert found[0] > found[-1] > 0.1
    train(_env(**changes), tmp_path / "parts", settings=SMALL, iterations=2, save_every=1)
    env = _env(**changes)
    assert float(env.goals.threshold) == pytest.approx(0.1)
    Trainer(env, SMALL).load(load_state(tmp_path / "parts" / STATE))
    assert float(env.goals.threshold) == pytest.approx(found[1])


def test_a_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1)
    with pytest.raises(UsageError, match=r"another run: settings\.epochs 2 \(now 3\)"):
        train(_env(), tmp_path, settings=replace(SMALL, epochs=3), iterations=2)


def test_a_run_does_not_go_on_with_another_task_touch_or_encoder(tmp_path: Path) -> None:
    train(_env(), tmp_path / "task", settings=SMALL, iterations=1)
    rewards = tasks.load("in_palm_rotate").rewards
    other: Any = {**rewards, "is_dropped": replace(rewards["is_dropped"], weight=-1.0)}
    changes: dict[str, Any]
    for changes, told in (
        ({"rewards": other}, "is_dropped"),
        ({"episode": 3.0}, "episode"),
        ({"rated_speed": False}, "rated_speed"),
    ):
        with pytest.raises(UsageError, match=f"another run: .*{told}"):
            train(_env(**changes), tmp_path / "task", settings=SMALL, iterations=2)
    felt = {"num_envs": 4, "threads": 1, "resolution": "low", "observe": "agg_bool"}
    sensed: dict[str, Any] = {"settings": SMALL, "observe": ("proprio", "touch")}
    train(tasks.make("in_palm_rotate", placement="tips", **felt), tmp_path / "felt", iterations=1, **sensed)
    for place, encoder, told in (("palm", "rnn", "placement"), ("tips", "mlp", "encoder")):
        env = tasks.make("in_palm_rotate", placement=place, **felt)
        with pytest.raises(UsageError, match=f"another run: .*{told}"):
            train(env, tmp_path / "felt", iterations=2, encoder=encoder, **sensed)


def test_a_policy_of_another_task_is_refused(tmp_path: Path) -> None:
    train(_env(), tmp_path, settings=SMALL, iterations=1)
    other = tasks.make("in_hand_repose", num_envs=2, threads=1)
    with pytest.raises(UsageError, match=r"'in_palm_rotate'.*'in_hand_repose' moves"):
        load_teacher(tmp_path, other)
    # Runs that do not state their actions are told by their weights.
    described = json.loads((tmp_path / "config.json").read_text())
    del described["action_map"]
    (tmp_path / "config.json").write_text(json.dumps(described))
    with pytest.raises(DataError, match=r"'in_hand_repose' .*'in_palm_rotate'"):
        load_teacher(tmp_path, other)
    with pytest.raises(DataError, match=r"/nothing' .*model_"):
        newest(tmp_path / "nothing")


def test_curiosity_is_scaled_by_the_control_step() -> None:
    trainer = Trainer(_env(), replace(SMALL, rnd_weight=100.0))
    assert trainer.algorithm.rnd is not None
    assert trainer.algorithm.rnd.initial_weight == pytest.approx(100.0 * 0.025)


def _check_mutants(folder, cases: int) -> None:
    whole = FOLDER / "in_palm_rotate.teacher"
    config, weights = (whole / "config.json").read_bytes(), newest(whole).read_bytes()
    env = tasks.make("in_palm_rotate", num_envs=2, config="careful")
    refused = 0
    for seed in range(cases):
        changed = json.dumps(mutate(json.loads(config), seed)).encode()
        (folder / "config.json").write_bytes((changed, damaged(config, seed), config)[seed % 3])
        (folder / newest(whole).name).write_bytes(damaged(weights, seed) if seed % 3 == 2 else weights)
        try:
            policy = load_teacher(folder, env)
        except BrainbenchError:
            refused += 1
        else:
            assert all(torch.isfinite(value).all() for value in policy.actor.state_dict().values())
    assert refused > cases // 3


def test_damaged_teachers_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 30)


@pytest.mark.slow
def test_many_damaged_teachers_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 500)


def _sensing_env(observe: str = "agg_bool") -> Env:
    task = replace(tasks.load("in_palm_rotate"), episode=1.0)
    return tasks.make(task, num_envs=4, observe=observe, placement="tips", threads=1)


def _sensing_run(folder: Path, iterations: int, **options: object) -> dict[str, torch.Tensor]:
    made = TeacherRun(iterations=iterations, save_every=1, observe=("proprio", "touch", "command"), **options)  # type: ignore[arg-type]
    train_teacher(_sensing_env(), folder, made)
    student, _ = load_student(folder)
    return student.state_dict()


@pytest.mark.slow
def test_a_policy_of_joints_and_touch_learns_goes_on_and_acts_as_a_student(tmp_path: Path) -> None:
    whole = _sensing_run(tmp_path / "whole", 2, loggers=("csv",))
    _sensing_run(tmp_path / "parts", 1)
    parts = _sensing_run(tmp_path / "parts", 2)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=0, msg=name)
    student, described = load_student(tmp_path / "whole" / SENSING)
    assert [name for name, _ in described["groups"]] == ["proprio", "command", "tactile"]
    assert described["deployment"]["command"] == [1.0]
    # Memory: the same observation is answered otherwise after another past.
    env = _sensing_env()
    policy, first = Policy(student), env.observations
    one = policy(first)
    assert not torch.equal(one, policy(first))
    assert len(evaluate(env, policy, episodes=4, seed=0).success) == 4
    with (tmp_path / "whole" / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    logged = [json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()]
    assert [float(row["reward"]) for row in rows] == [row["reward"] for row in logged]
    assert not list((tmp_path / "whole").glob("tensorboard"))


@pytest.mark.parametrize("encoder", [pytest.param("rnn", marks=pytest.mark.slow), "auto"])
def test_forces_of_all_taxels_are_learned_from_or_the_run_says_that_it_diverged(tmp_path: Path, encoder: str) -> None:
    env = tasks.make("in_palm_rotate", num_envs=4, observe="force_torque", threads=1)
    options = TeacherRun(iterations=2, observe=("proprio", "touch"), encoder=encoder, loggers=())
    if encoder == "rnn":
        losses = train_teacher(env, tmp_path, options).history[-1]
        assert all(math.isfinite(value) for name, value in losses.items() if name.startswith("loss/"))
        return
    # A convolutional GRU with layer norm: through 24 steps of an untouched map the gradient overflows.
    with pytest.raises(DataError, match=r"diverged: after iteration 1 .*another encoder"):
        train_teacher(env, tmp_path, options)
    assert not list(tmp_path.glob("*.safetensors"))


def test_features_are_counted_once_a_step_after_it_was_learned_from() -> None:
    """Padding of sequences counts for nothing, and the policy that learns gives actions the odds that they had."""
    env = tasks.make("in_palm_rotate", num_envs=4, observe="agg_force", placement="tips", threads=1)
    trainer = Trainer(env, seed=0, observe=("proprio", "touch"), encoder="reservoir")
    actor, batches, gaps = trainer.algorithm.actor, [], []
    make_batches, log_prob = trainer.algorithm.storage.recurrent_mini_batch_generator, actor.get_output_log_prob

    def noted_batches(*sizes: int):
        for batch in make_batches(*sizes):
            batches.append(batch)
            yield batch

    def noted_odds(actions: torch.Tensor) -> torch.Tensor:
        odds = log_prob(actions)
        if batches:
            gaps.append(float((odds.detach() - batches[-1].old_actions_log_prob.squeeze()).abs().max()))
        return odds

    trainer.algorithm.storage.recurrent_mini_batch_generator, actor.get_output_log_prob = noted_batches, noted_odds
    for iteration in (1, 2):
        trainer.iterate()
        assert float(actor.core.tactile.norm.count) == iteration * trainer.config["num_steps_per_env"] * 4
        assert gaps[0] < 1e-4
        batches.clear()
        gaps.clear()


@pytest.mark.parametrize(("envs", "parts"), [(2, 1), (5, 1), (6, 3), (8, 4)])
def test_a_policy_with_memory_learns_from_every_step_of_few_environments(envs: int, parts: int) -> None:
    env = tasks.make("in_palm_rotate", num_envs=envs, observe="agg_bool", placement="tips", threads=1)
    trainer = Trainer(env, seed=0, observe=("proprio", "touch"))
    storage, sizes = trainer.algorithm.storage, []
    make_batches = storage.recurrent_mini_batch_generator

    def noted_batches(*counts: int):
        for batch in make_batches(*counts):
            sizes.append(batch.advantages.numel())
            # Single environments lose their axis, and every step would meet every other.
            assert batch.old_actions_log_prob.squeeze().shape == batch.actions.shape[:-1]
            yield batch

    storage.recurrent_mini_batch_generator = noted_batches
    row = trainer.iterate()
    epochs, steps = trainer.config["algorithm"]["num_learning_epochs"], trainer.config["num_steps_per_env"]
    assert sizes == [envs * steps // parts] * (parts * epochs)
    assert all(math.isfinite(value) for name, value in row.items() if name.startswith("loss/"))


def test_a_single_environment_is_too_few_for_a_policy_with_memory() -> None:
    env = tasks.make("in_palm_rotate", num_envs=1, observe="agg_bool", placement="tips", threads=1)
    with pytest.raises(UsageError, match="at least two environments at a time; received 1"):
        Trainer(env, seed=0, observe=("proprio", "touch"))


def test_what_a_hand_has_not_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    refused = [("tuch", "did you mean 'touch'"), ("goal", "'goal', which only"), ("priv_proprio", "'priv_proprio'")]
    for name, culprit in refused:
        with pytest.raises(UsageError, match=culprit):
            TeacherRun(observe=("proprio", name))
    with pytest.raises(UsageError, match="gives no 'thermal'"):
        train_teacher(_sensing_env(), tmp_path, TeacherRun(observe=("proprio", "thermal"), iterations=1))
    with pytest.raises(UsageError, match="gives no 'tactile'"):
        train_teacher(_sensing_env("none"), tmp_path, TeacherRun(observe=("proprio", "touch"), iterations=1))


def _config(**changes) -> DistillConfig:
    plain = {"task": "follow", "placement": "tips", "resolution": "low", "encoder": "zhuang-small"}
    return DistillConfig(**{**plain, **changes})


def test_a_networks_hand_calibration_is_measured_while_the_teacher_acts_and_then_kept(tmp_path) -> None:
    config = calibrated(_config(), TouchWorld(16), Follower(), tmp_path)
    found = config.encoder_settings["calibration"]
    # Two taxels of a tip carry forces of 0.2 N times a standard normal aim, in sites of their own: rms of three axes.
    assert found["force"] == pytest.approx(0.2 / 3**0.5, rel=0.25)
    assert config.tactile is not None
    assert config.tactile.calibration.force == found["force"]
    write_json(tmp_path / "config.json", {"distill": asdict(config)})
    again = calibrated(_config(), TouchWorld(16, seed=5), Follower(), tmp_path)
    assert again == config


def test_learned_encoders_and_given_calibrations_are_left_alone(tmp_path) -> None:
    for config in (
        _config(encoder="mlp"), DistillConfig(task="follow", observe="none"),
        _config(encoder_settings={"calibration": {"force": 2.0}}),
    ):  # fmt: skip
        assert calibrated(config, TouchWorld(2), Follower(), tmp_path) is config


def test_a_teacher_that_touches_nothing_is_mentioned(tmp_path, caplog) -> None:
    class Numb(TouchWorld):
        def _observe(self):
            found = super()._observe()
            found["tactile"] = found["tactile"] * 0
            return found

    with caplog.at_level(logging.WARNING):
        config = calibrated(_config(), Numb(2), Follower(), tmp_path)
    assert config.encoder_settings["calibration"]["force"] == 0.5
    assert "touched nothing" in caplog.text


def test_a_student_needs_a_teacher(tmp_path) -> None:
    with pytest.raises(UsageError, match=r"teacher: .*brainbench policy train"):
        train_student(_config(), tmp_path)


@pytest.mark.parametrize(
    ("teacher", "changes", "contacts"),
    [
        ("published", {}, "published"),
        ("firm", {}, "firm"),
        ("published", {"contacts": "firm"}, "firm"),
        ("firm", {"variant": "published"}, "published"),
    ],
)
def test_a_student_is_taught_in_the_contacts_of_its_teacher_unless_told_otherwise(
    tmp_path, teacher, changes, contacts
) -> None:
    config = DistillConfig(
        task="in_palm_rotate", teacher=str(teacher_in(teacher, tmp_path / "teacher")), observe="none", hidden=(8,),
        num_envs=2, steps_per_env=2, iterations=1, epochs=1, **changes,
    )  # fmt: skip
    train_student(config, tmp_path / "run", StudentRun(episodes=0))
    described = read_json(tmp_path / "run" / "config.json")
    assert described["distill"]["contacts"] == contacts
    assert (described["deployment"]["twist"] is None) == (config.variant == "default")
    assert trained_contacts(described) == trained_contacts(described["deployment"]) == CONTACTS[contacts]


def test_a_student_is_done_once_the_very_one_was_evaluated_after_its_last_iteration(tmp_path) -> None:
    config = DistillConfig(task="in_palm_rotate", teacher="in_palm_rotate.teacher", observe="none", num_envs=2)
    stored = replace(config.resolved(tasks.load("in_palm_rotate").student), contacts="firm")
    assert not is_done(config, tmp_path)
    write_json(tmp_path / "config.json", {"distill": asdict(stored), "task_version": TASK_VERSION})
    for iterations, done in ((stored.iterations, True), (3, False)):
        write_json(tmp_path / "evaluation.json", [{"seed": 1000, "success": [0.0], "iterations": iterations}])
        assert is_done(config, tmp_path) is done
    assert is_done(config, tmp_path, stop_at=3)
    assert not is_done(config, tmp_path, stop_at=4)
    write_json(tmp_path / "evaluation.json", [{"seed": 1000, "success": [0.0]}])
    assert is_done(config, tmp_path)
    changes = ({"iterations": 3}, {"steps_per_env": 3}, {"contacts": "published"}, {"teacher": "runs/other"})
    assert not any(is_done(replace(config, **change), tmp_path) for change in changes)
    # What another version of the tasks trained is no student of this one.
    write_json(tmp_path / "config.json", {"distill": asdict(stored), "task_version": TASK_VERSION - 1})
    with pytest.raises(DataError, match=r"version 2 of the tasks.*train it again"):
        is_done(config, tmp_path)


def test_a_student_of_a_teacher_that_was_trained_anew_in_its_folder_is_another(tmp_path) -> None:
    teacher, student = tmp_path / "teacher", tmp_path / "student"
    train(_env(), teacher, settings=SMALL, iterations=1)
    config = DistillConfig(
        task="in_palm_rotate", teacher=str(teacher), observe="none", num_envs=1, iterations=2, steps_per_env=2
    )
    train_student(config, student, StudentRun(episodes=1, evaluations=1))
    assert is_done(config, student)
    train(_env(), teacher, settings=SMALL, iterations=2)
    assert not is_done(config, student)
    with pytest.raises(UsageError, match="holds another student: teacher_hash"):
        train_student(config, student, StudentRun(episodes=0))
    # Without the teacher, nothing says that it changed.
    shutil.rmtree(teacher)
    assert is_done(config, student)


def test_a_run_does_not_begin_with_a_file_without_actor_and_critic(tmp_path) -> None:
    for name, tree in (("actor", {"critic": {}}), ("critic", load_state(newest(FOLDER / "hot_ball.teacher")))):
        tree.pop(name, None)
        save_state(tmp_path / "state.safetensors", tree | {"iteration": 3})
        with pytest.raises(DataError, match=f"state.safetensors' holds no {name}, and a run begins with"):
            Trainer(_env(), SMALL).begin_from(tmp_path / "state.safetensors")


def test_resampled_time_is_for_readings_as_often_as_the_encoder_assumes(tmp_path, monkeypatch) -> None:
    task = tasks.load("in_palm_rotate")
    slow = replace(task, solver=replace(task.solver, timestep=0.004))
    monkeypatch.setattr(tasks, "load", lambda name, variant: slow)
    config = _config(task="in_palm_rotate", teacher="in_palm_rotate.teacher", encoder_settings={"time": "resampled"})
    with pytest.raises(UsageError, match=r"every 0\.005 s; those of 'in_palm_rotate' come every 0\.004 s"):
        train_student(config, tmp_path)
