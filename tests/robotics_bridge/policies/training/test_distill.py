"""Distillation of students that feel."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from brainbench.core.errors import BrainbenchError, DataError, MissingDependencyError, UsageError
from brainbench.core.files import lock_folder
from robotics_bridge import hands
from robotics_bridge.hands.layouts import write_probes
from robotics_bridge.policies.evaluate import Policy
from robotics_bridge.policies.training import distill as training
from robotics_bridge.policies.training.distill import CONFIG, MODEL, ChunkStep, distill, load_student
from robotics_bridge.policies.training.distill_config import DistillConfig
from tests.factories.damage import damaged, mutate
from tests.factories.policies import student_folder
from tests.factories.task_worlds import Follower, TouchWorld


def _changed(folder, **changes):
    path = folder / CONFIG
    config = json.loads(path.read_text())
    for name, value in changes.items():
        (config["distill"] if name in config["distill"] else config)[name] = value
    path.write_text(json.dumps(config))
    return folder


def _check_mutants(folder, cases: int) -> None:
    student_folder(folder)
    config, weights = (folder / CONFIG).read_bytes(), (folder / MODEL).read_bytes()
    refused = longest = slowest = 0
    for seed in range(cases):
        values = (json.dumps(mutate(json.loads(config), seed)).encode(), damaged(config, seed), config)[seed % 3]
        (folder / CONFIG).write_bytes(values)
        (folder / MODEL).write_bytes(damaged(weights, seed) if seed % 3 == 2 else weights)
        begun = time.monotonic()
        try:
            student, _ = load_student(folder)
        except BrainbenchError as error:
            refused, longest = refused + 1, max(longest, len(str(error)))
        else:
            assert all(torch.isfinite(value).all() for value in student.state_dict().values())
        slowest = max(slowest, time.monotonic() - begun)
    assert refused > cases // 3
    assert longest < 800
    assert slowest < 10


def test_damaged_folders_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 30)


@pytest.mark.slow
def test_many_damaged_folders_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 500)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("hidden", [[10**9], [65536, 65536], [], [0], "512", [8, 8]]),
        ("learning_rate", [float("nan"), float("inf"), 0.0, -1.0, 2.0, "fast"]),
        ("teacher_share", [float("nan"), 1.5]),
        ("num_envs", [0, -1, 1.5, 10**30, True]),
        ("encoder_settings", [{"features": 10**9}, {"features": 0}, {"slots": -1}, {"speed": 1}, []]),
        ("actions", [0, 1.0, 10**6, None]),
        ("groups", [[], [["proprio", [10**9]]], [["proprio", [9]], ["command", [1]], ["tactile", [5, 5, 3]]]]),
    ],
)
def test_sizes_and_numbers_out_of_range_are_refused_before_memory_is_taken(tmp_path, name, values) -> None:
    for value in values:
        with pytest.raises(BrainbenchError, match=f"{name}|features|slots|speed|describes|share"):
            load_student(_changed(student_folder(tmp_path), **{name: value}))


def test_weights_that_are_not_finite_are_refused_by_name(tmp_path) -> None:
    student_folder(tmp_path)
    weights = load_file(tmp_path / MODEL)
    weights["mlp.2.bias"][0] = float("nan")
    save_file(weights, tmp_path / MODEL)
    with pytest.raises(DataError, match=r"mlp\.2\.bias"):
        load_student(tmp_path)


@pytest.mark.parametrize("place", ["{folder}/encoder.py:build", "encoder:build", "./encoder.py"])
def test_no_code_of_a_folder_runs(tmp_path, monkeypatch, place) -> None:
    ran = tmp_path / "ran"
    (tmp_path / "encoder.py").write_text(f"open({str(ran)!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    folder = _changed(student_folder(tmp_path / "student"), encoder=place.format(folder=tmp_path))
    with pytest.raises(UsageError, match="encoder"):
        load_student(folder)
    assert not ran.exists()


def _learn(device: str, *, record: bool, steps: int = 8) -> list[torch.Tensor]:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 8), nn.ELU(), nn.Linear(8, 2)).to(device)
    cuda = device == "cuda"
    optimizer = torch.optim.Adam(net.parameters(), 1e-2, fused=cuda, capturable=cuda)

    def loss(given: Any) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        y = net(given["x"]) + given["memory"]
        return {"fit": (y - 1).pow(2).mean(), "size": 0.1 * y.abs().mean()}, 0.5 * y

    step = ChunkStep(loss, list(net.parameters()), optimizer, clip=0.5, record=record)
    memory, found = torch.zeros(4, 2, device=device), []
    for _ in range(steps):
        parts, memory = step({"x": torch.randn(4, 3).to(device), "memory": memory})
        found.append(torch.stack([value.clone() for value in parts.values()]).cpu())
    # A last piece of another size is learned from too.
    parts, _ = step({"x": torch.randn(2, 3).to(device), "memory": memory[:2]})
    return [*found, torch.stack(list(parts.values())).cpu()]


def test_each_step_descends_and_hands_on_the_memory() -> None:
    found = _learn("cpu", record=False, steps=200)
    assert float(found[-1][0]) < 0.5 * float(found[0][0])
    assert not any(value.requires_grad for value in found)


@pytest.mark.gpu
def test_recorded_steps_learn_what_unrecorded_ones_do() -> None:
    plain, recorded = _learn("cuda", record=False), _learn("cuda", record=True)
    for one, two in zip(plain, recorded, strict=True):
        torch.testing.assert_close(two, one)


def _config(**changes) -> DistillConfig:
    plain = {
        "task": "follow", "placement": "tips", "resolution": "low", "encoder": "mlp", "embedder": "none",
        "hidden": (32, 32), "num_envs": 16, "steps_per_env": 8, "save_interval": 2,
    }  # fmt: skip
    felt = ("placement", "resolution", "encoder") if changes.get("observe") == "none" else ()
    return DistillConfig(**{key: value for key, value in {**plain, **changes}.items() if key not in felt})


def _run(out, env=None, teacher=None, **changes):
    config = _config(**changes)
    world = env or TouchWorld(16, observe=config.observe)
    return distill(config, out, env=world, teacher=teacher or Follower())


def _losses(folder) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == "loss"]


@pytest.mark.slow
def test_a_student_that_feels_learns_what_one_without_touch_cannot(tmp_path) -> None:
    settings = {"iterations": 40, "learning_rate": 5e-3, "epochs": 4, "save_interval": 40, "steps_per_env": 16}
    felt = _run(tmp_path / "felt", **settings)
    numb = _run(tmp_path / "numb", observe="none", **settings)
    assert felt.status == numb.status == "finished"
    # Without touch the best guess of the aim is what the joints' own past tells.
    assert felt.loss < 0.4 * numb.loss
    last = _losses(tmp_path / "felt")[-1]
    assert last["aux_aim"] < 0.4 * _losses(tmp_path / "numb")[-1]["aux_aim"]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"encoder": "zhuang-small", "embedder": "lstm", "aggregate": 2, "teacher_share": 0.5, "teacher_iterations": 4},
        {"encoder": "tactile_convrnn", "noisy": True, "loss": "inv_var_mse", "clip": 0.1, "max_grad_norm": 0.5},
    ],
)
def test_a_killed_run_goes_on_exactly(tmp_path, changes) -> None:
    unbroken = _run(tmp_path / "a", iterations=4, **changes)

    class Killed(TouchWorld):
        steps = 0

        def step(self, action):
            self.steps += 1
            if self.steps > 3 * 8 - 4:  # in the third iteration, after the state of the second was saved
                raise KeyboardInterrupt
            return super().step(action)

    with pytest.raises(KeyboardInterrupt):
        _run(tmp_path / "b", Killed(16), iterations=4, **changes)
    resumed = _run(tmp_path / "b", iterations=4, **changes)
    assert resumed.iterations == unbroken.iterations == 4
    assert resumed.loss == unbroken.loss
    first, second = (load_student(tmp_path / name)[0].state_dict() for name in "ab")
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=0, atol=0, msg=name)
    assert _losses(tmp_path / "a") == _losses(tmp_path / "b")


@pytest.mark.parametrize("written", [False, True])
def test_a_run_that_is_killed_while_it_saves_goes_on_exactly(tmp_path, monkeypatch, written) -> None:
    changes = {"iterations": 2, "encoder": "mlp", "noisy": True, "aggregate": 2}
    _run(tmp_path / "a", **changes)
    save = training.save_state

    def killed(path, tree):
        if written:
            save(path, tree)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(training, "save_state", killed)
        with pytest.raises(KeyboardInterrupt):
            _run(tmp_path / "b", **changes)
    stored = tmp_path / "b" / "rollouts" / "0.safetensors"
    if not written:  # what no state names is of another course of the run, as on a device that is not exact
        save_file({name: value * 0 for name, value in load_file(stored).items()}, stored)
    assert _run(tmp_path / "b", **changes).status == "finished"
    for name in (MODEL, "rollouts/0.safetensors", "rollouts/1.safetensors"):
        first, second = (load_file(tmp_path / run / name) for run in "ab")
        assert first.keys() == second.keys()
        assert all(torch.equal(value, second[key]) for key, value in first.items()), name


def test_a_run_that_stops_after_some_iterations_goes_on_exactly(tmp_path) -> None:
    whole = _run(tmp_path / "a", iterations=4)
    first = distill(_config(iterations=4), tmp_path / "b", env=TouchWorld(16), teacher=Follower(), stop_at=3)
    assert (first.status, first.iterations) == ("stopped", 3)
    assert first.reason.startswith("3 iterations are done, as many as were allowed")
    assert _run(tmp_path / "b", iterations=4).loss == whole.loss


def test_a_loaded_student_acts_as_the_one_that_was_saved_and_forgets_on_reset(tmp_path) -> None:
    _run(tmp_path, iterations=2, encoder="zhuang-small")
    student, described = load_student(tmp_path)
    assert described["deployment"]["rate"] == 40
    assert described["deployment"]["frozen"] == {"c": 0.5}
    policy, world = Policy(student), TouchWorld(3)
    first = [policy(world.observations) for _ in range(5)]
    policy.reset(torch.tensor([True, False, False]))
    again = policy(world.observations)
    torch.testing.assert_close(again[0], first[0][0])
    policy.reset()
    torch.testing.assert_close(policy(world.observations), first[0])


@pytest.mark.parametrize(
    "changes",
    [
        # As `policy distill` leaves every network: with the calibration that it measured.
        {"encoder": "zhuang-small", "encoder_settings": {"calibration": {"force": 2.0, "moment": 0.1}}},
        {"encoder": "zhuang-small", "encoder_settings": {"learning": "finetuned", "options": {"unroll": "full"}}},
        {"encoder": "zhuang-small.simclr", "encoder_settings": {"time": "resampled"}},
        {"encoder": "rnn", "encoder_settings": {"units": 9}},
        {"encoder": "reservoir", "encoder_settings": {"seed": 3, "features": 16}},
    ],
)
def test_a_student_whose_encoder_has_settings_is_read_again_with_them(tmp_path, changes) -> None:
    config = _config(**changes)
    _run(tmp_path, iterations=1, **changes)
    student, described = load_student(tmp_path)
    assert DistillConfig.of(described["distill"]).tactile == config.tactile
    assert torch.isfinite(Policy(student)(TouchWorld(3).observations)).all()


def test_a_student_is_not_read_with_another_probe_file_of_its_name(tmp_path) -> None:
    file, hand = tmp_path / "own.json", hands.load("xhand1")
    usual = hand.layout("low", "tips")
    write_probes(file, usual)
    _run(tmp_path / "run", iterations=1, resolution=str(file))
    load_student(tmp_path / "run")
    # As many taxels on the same links, elsewhere.
    write_probes(file, {link: replace(probes, position=probes.position + 0.002) for link, probes in usual.items()})
    for read in (load_student, partial(_run, iterations=1, resolution=str(file))):
        with pytest.raises(DataError, match=r"own\.json' has changed"):
            read(tmp_path / "run")


def test_the_teacher_acts_in_its_share_of_steps(tmp_path) -> None:
    class Counting(TouchWorld):
        matched: tuple[int, int] = (0, 0)

        def step(self, action):
            right = Follower()(self.observations)
            hits = int((action == right).all(1).sum())
            self.matched = (self.matched[0] + hits, self.matched[1] + len(action))
            return super().step(action)

    found = {}
    for share in (0.0, 0.5, 1.0):
        world = Counting(64)
        _run(tmp_path / str(share), world, iterations=2, teacher_share=share)
        found[share] = world.matched[0] / world.matched[1]
    assert found[0.0] == 0
    assert found[0.5] == pytest.approx(0.5, abs=4 * math.sqrt(0.25 / 1024))
    assert found[1.0] == 1
    config = _config(teacher_share=0.8, teacher_iterations=4)
    assert [round(config.share(i), 3) for i in range(6)] == [0.8, 0.6, 0.4, 0.2, 0.0, 0.0]


def test_a_frozen_network_sees_each_step_once_and_is_left_as_it_was(tmp_path) -> None:
    from brainbench import load_model

    _run(tmp_path, iterations=2, encoder="zhuang-small")
    student, _ = load_student(tmp_path)
    own = load_model("zhuang-small").state_dict()
    for name, value in student.core.tactile.front.step.model.state_dict().items():  # type: ignore[union-attr]
        torch.testing.assert_close(value, own[name], rtol=0, atol=0)


def test_a_loss_that_is_no_number_ends_the_run_with_its_last_good_state(tmp_path) -> None:
    class Mad(Follower):
        calls = 0

        def __call__(self, obs):
            self.calls += 1
            return super().__call__(obs) * (float("nan") if self.calls > 2 * 8 else 1.0)

    result = _run(tmp_path, teacher=Mad(), iterations=4)
    assert result.status == "diverged"
    assert "iteration 3 is not finite" in result.reason
    student, _ = load_student(tmp_path)
    assert all(torch.isfinite(value).all() for value in student.state_dict().values())


def test_tables_4_4_fills_what_is_left_open_and_logs_say_what_was_learned(tmp_path) -> None:
    result = _run(tmp_path)
    assert result.iterations == 4
    saved = json.loads((tmp_path / "config.json").read_text())["distill"]
    assert (saved["learning_rate"], saved["epochs"], saved["gradient_length"]) == (1e-3, 2, 2)
    kinds = {json.loads(line)["kind"] for line in (tmp_path / "log.jsonl").read_text().splitlines()}
    assert kinds == {"loss", "time", "teacher", "episode"}
    assert list((tmp_path / "tensorboard").iterdir())


def test_requests_that_do_not_fit_are_refused(tmp_path) -> None:
    _run(tmp_path, iterations=2)
    with pytest.raises(UsageError, match=r"another student: learning_rate .* \(now 0\.01\)"):
        _run(tmp_path, iterations=2, learning_rate=1e-2)
    with lock_folder(tmp_path), pytest.raises(UsageError, match="Another process is writing"):
        _run(tmp_path, iterations=3)
    with pytest.raises(UsageError, match="did you mean 'mse'"):
        _config(loss="ms")
    with pytest.raises(UsageError, match=r"teacher_share.* received 2"):
        _config(teacher_share=2)
    with pytest.raises(UsageError, match="did you mean 'placement'"):
        DistillConfig.of({"task": "x", "placment": "tips"})
    with pytest.raises(UsageError, match=r"num_envs.* received 0"):
        _config(num_envs=0)
    with pytest.raises(UsageError, match=r"hidden.* received -4"):
        _config(hidden=(12, -4))
    with pytest.raises(UsageError, match=r"hidden.* holds at least 1 values; received \[\]"):
        _config(hidden=())
    with pytest.raises(UsageError, match=r"stop_after must be a finite number, at least 0; received nan"):
        distill(_config(), tmp_path, env=None, teacher=Follower(), stop_after=math.nan)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(DataError, match=r"student; .*policy distill"):
        load_student(tmp_path)


def test_without_the_package_for_training_nothing_is_distilled(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rsl_rl.models", None)
    with pytest.raises(MissingDependencyError, match=r"rsl-rl-lib.*policies"):
        _run(tmp_path, iterations=1)
    assert not (tmp_path / "config.json").exists()


def test_a_student_begins_with_the_weights_of_another(tmp_path) -> None:
    _run(tmp_path / "first", iterations=4, learning_rate=5e-3)
    first, _ = load_student(tmp_path / "first")
    _run(tmp_path / "second", iterations=1, learning_rate=1e-12, start=str(tmp_path / "first"), seed=5)
    second, _ = load_student(tmp_path / "second")
    for name, value in first.named_parameters():
        torch.testing.assert_close(second.get_parameter(name), value, rtol=0, atol=1e-6, msg=name)
    with pytest.raises(DataError, match=r"one that feels and acts alike: .*'core\."):
        _run(tmp_path / "third", iterations=1, encoder="rnn", start=str(tmp_path / "first"))
    with pytest.raises(UsageError, match="student 'nobody'"):
        _run(tmp_path / "fourth", iterations=1, start="nobody")
