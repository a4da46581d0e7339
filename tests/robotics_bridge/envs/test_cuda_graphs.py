"""Control steps as CUDA graphs: what can be told of them on a processor, and on a GPU the graphs themselves.

A recording freezes everything but the memory it works on. On a processor one is imitated: the operations of torch, the
launches of Warp and the calls of C MuJoCo that a step made are done again on the same memory.
"""

from __future__ import annotations

import gc
import logging
import traceback
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from brainbench.core.devices import CudaGraphStep, Recorder, warp
from brainbench.core.errors import UsageError
from brainbench.core.rotations import constant
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.envs.simulation import Simulation
from robotics_bridge.envs.step import apply_action, compute_step
from robotics_bridge.tasks.task import Reward
from robotics_bridge.tasks.terms import StepContext

TOUCHING = {"observe": "force_torque", "resolution": "low", "noisy": True, "link_pose": True}
CASES = [("in_palm_rotate", TOUCHING), ("in_hand_repose", {}), ("screwdriver", {}), ("hot_ball", {})]


def _make(task: Any, options: dict[str, Any], **more: Any) -> Env:
    if isinstance(task, str):
        task = replace(tasks.load(task), episode=0.2)
    return tasks.make(task, **{"num_envs": 3, "seed": 3, "keep_final": True, **options, **more})


class _Waits(TorchDispatchMode):
    """Notes operations that on CUDA would copy from the host, wait for the device or have a shape of data."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(func).split(".")[1]
        bad = name in ("lift_fresh", "lift", "_local_scalar_dense", "nonzero", "masked_select")
        if name in ("index", "index_put", "index_put_"):
            bad |= any(index is not None and index.dtype == torch.bool for index in args[1])
            # On CUDA the number that is put is a tensor on the host.
            bad |= name != "index" and args[2].dim() == 0
        if bad:
            frame = next(f for f in reversed(traceback.extract_stack()[:-1]) if "/torch/" not in f.filename)
            self.found.append(f"{name}: {frame.filename}: {frame.line}")
        return func(*args, **(kwargs or {}))


@pytest.mark.slow
@pytest.mark.parametrize(("task", "options"), CASES, ids=[case[0] for case in CASES])
def test_a_control_step_neither_copies_from_the_host_nor_waits_for_the_device(task: str, options: Any) -> None:
    env = _make(task, options, threads=1)
    action = torch.zeros(3, env.num_actions)
    env.step(action)
    with _Waits() as waits:
        for _ in range(9):
            env.step(action)
    # C MuJoCo lives on the host.
    assert [line for line in waits.found if "envs/simulation.py" not in line] == []
    assert any("envs/simulation.py" in line for line in waits.found)


@pytest.mark.parametrize(
    "work",
    [
        lambda x: torch.tensor(3.0),
        lambda x: torch.as_tensor([1, 2]),
        lambda x: x[[0, 1]],
        lambda x: x[x > 0],
        lambda x: x[0].item(),
        lambda x: bool(x.any()),
        lambda x: x.__setitem__(torch.arange(2), 0.0),
        torch.nonzero,
    ],
)
def test_what_would_wait_is_noticed(work: Callable[[torch.Tensor], Any]) -> None:
    x = torch.ones(4)
    index = torch.arange(2)
    with _Waits() as waits:
        _ = x[index], x[:2], x.masked_fill(x > 2, 0.0)
    assert waits.found == []
    with _Waits() as waits:
        work(x)
    assert len(waits.found) >= 1


class _Tape(TorchDispatchMode):
    """Remembers what was done to which memory, and does it again."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[Callable[[], Any]] = []
        self.off = False
        self._fresh = True

    def note(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is noted as a whole."""

        def noted(*args: Any, **kwargs: Any) -> Any:
            self.done.append(lambda: call(*args, **kwargs))
            self.off, before = True, self.off
            try:
                return call(*args, **kwargs)
            finally:
                self.off = before

        return noted

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        if self.off:
            return out
        if func._schema.is_mutable:
            self.done.append(lambda: func(*args, **kwargs))
            return out
        inputs = {t.untyped_storage().data_ptr() for t in _tensors((args, kwargs))}
        fresh = [t for t in _tensors(out) if t.untyped_storage().data_ptr() not in inputs]
        if fresh:

            def again() -> None:
                for old, new in zip(_tensors(out), _tensors(func(*args, **kwargs)), strict=True):
                    old.copy_(new)

            self.done.append(again)
        return out

    def replay(self) -> None:
        """Do it again; the first time was the recording."""
        if not self._fresh:
            for call in self.done:
                call()
        self._fresh = False


def _tensors(tree: Any) -> list[torch.Tensor]:
    return [leaf for leaf in _pytree.tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def _tape_recorder(native: bool) -> Recorder:
    """Record on a tape; physics of MuJoCo Warp is all launches, C MuJoCo is noted call by call."""

    def record(work: Callable[[], Any]) -> tuple[Any, Any]:
        tape, wp = _Tape(), warp()
        with pytest.MonkeyPatch.context() as patch, tape:
            patch.setattr(wp, "launch", tape.note(wp.launch))
            # What sensors launch again on a processor is packed.
            patch.setattr(wp.Launch, "launch", tape.note(wp.Launch.launch))
            patch.setattr(wp.array, "zero_", tape.note(wp.array.zero_))
            for name in () if native else ("reset", "refresh", "apply_push"):
                patch.setattr(Simulation, name, tape.note(getattr(Simulation, name)))
            result = work()
        return tape, result

    return record


def _imitate(env: Env) -> tuple[CudaGraphStep, CudaGraphStep]:
    record, generators = _tape_recorder(env.simulation.uses_warp), [env.state.generator]
    parts = (
        CudaGraphStep(apply_action, record, subject="It", generators=generators),
        CudaGraphStep(compute_step, record, subject="It", generators=generators, retained=env.lasting),
    )
    env.apply_action, env.compute_step = parts
    return parts


def _same(first: Any, second: Any) -> None:
    mine, other = _pytree.tree_leaves_with_path(first), _pytree.tree_leaves_with_path(second)
    assert [path for path, _ in mine] == [path for path, _ in other]
    for (path, one), (_, two) in zip(mine, other, strict=True):
        assert torch.equal(one.nan_to_num(), two.nan_to_num()), path


@pytest.mark.parametrize(
    ("task", "options"),
    [*CASES, pytest.param("in_palm_rotate", {**TOUCHING, "engine": "warp"}, marks=pytest.mark.slow)],
    ids=[*(case[0] for case in CASES), "mujoco-warp"],
)
def test_nothing_that_changes_from_step_to_step_lives_outside_the_memory_of_a_recording(
    task: str, options: dict[str, Any]
) -> None:
    if options.get("engine") == "warp":
        pytest.importorskip("mujoco_warp")
    one, two = (_make(task, options, threads=1) for _ in range(2))
    parts = _imitate(two)
    generator = torch.Generator().manual_seed(0)
    ended = 0
    for _ in range(20):
        action = 0.5 * torch.randn(3, one.num_actions, generator=generator)
        first, second = one.step(action), two.step(action)
        ended += int((first[2] | first[3]).sum())
        _same(first, second)
    assert all(part.recorded for part in parts)
    assert two.recorded
    assert not one.recorded
    assert ended >= 6
    _same(one.state_dict(), two.state_dict())


def test_a_saved_state_goes_on_in_a_recorded_environment() -> None:
    one, two = (_make("in_palm_rotate", {}, threads=1) for _ in range(2))
    _imitate(two)
    for _ in range(5):
        one.step(torch.zeros(3, 5))
        two.step(torch.ones(3, 5))
    two.load_state_dict(one.state_dict())
    for _ in range(10):
        _same(one.step(torch.zeros(3, 5)), two.step(torch.zeros(3, 5)))
    one.seed(8)
    two.seed(8)
    mask = torch.tensor([True, False, True])
    _same(one.reset(mask), two.reset(mask))
    for env in (one, two):
        env.episode_length_buf = torch.tensor([5, 6, 7])
    _same(one.step(torch.zeros(3, 5)), two.step(torch.zeros(3, 5)))


def test_what_a_step_returned_is_not_overwritten_by_the_next_but_for_touch() -> None:
    env = _make("in_palm_rotate", TOUCHING, threads=1)
    _imitate(env)
    for _ in range(3):
        returned = env.step(torch.zeros(3, 5))
    kept = _pytree.tree_map(torch.clone, returned)
    env.step(torch.ones(3, 5))
    for result in (returned, kept):
        result[0].pop("tactile")
    _same(returned, kept)


def test_an_environment_does_not_outlive_its_last_reference() -> None:
    # Its device memory would wait for Python's collector, and be freed in the middle of another recording.
    env = _make("in_palm_rotate", {}, threads=1)
    _imitate(env)
    for _ in range(4):
        env.step(torch.zeros(3, 5))
    seen = weakref.ref(env), weakref.ref(env.state)
    gc.disable()
    try:
        del env
        assert [reference() for reference in seen] == [None, None]
    finally:
        gc.enable()


def test_graphs_are_refused_on_a_processor() -> None:
    with pytest.raises(UsageError, match=r"CUDA only.* on cpu"):
        tasks.make("in_palm_rotate", graphs=True)


def test_a_constant_is_made_once() -> None:
    like = torch.zeros(2, dtype=torch.float64)
    first = constant((1.0, 2.0), like)
    assert first is constant([1.0, 2.0], like)
    assert first.dtype == torch.float64
    with torch.inference_mode():
        assert not constant((1.0, 3.0), like).is_inference()


def _waiting(m: StepContext) -> torch.Tensor:
    return m.power * float(m.power.sum())


def test_a_part_after_a_loaded_state_reads_the_same_temperatures_again() -> None:
    # What the test below rests on, without a GPU. The episode of .2 s ends within these steps, which cools fingers.
    env = _make("hot_ball", {}, threads=1)
    for _ in range(12):
        env.step(torch.zeros(3, env.num_actions))
        state = env.state_dict()
        found = []
        for _ in range(2):
            env.load_state_dict(state)
            found.append(_pytree.tree_map(torch.clone, compute_step(env.state, env.reset_episodes)))
        leaves = (_pytree.tree_leaves_with_path(one) for one in found)
        for (path, one), (_, two) in zip(*leaves, strict=True):
            assert torch.allclose(one.float(), two.float(), rtol=1e-4, atol=1e-4, equal_nan=True), path


@pytest.mark.gpu
@pytest.mark.parametrize("task", [case[0] for case in CASES])
def test_a_replayed_part_is_the_eager_part(task: str) -> None:
    env = _make(task, {}, num_envs=64, device="cuda", graphs=True)
    part = env.compute_step
    assert isinstance(part, CudaGraphStep)
    for _ in range(12):
        env.step(torch.randn(64, env.num_actions, device="cuda"))
        if not part.recorded:
            continue
        state = env.state_dict()
        env.load_state_dict(state)
        eager = _pytree.tree_map(torch.clone, compute_step(env.state, env.reset_episodes))
        env.load_state_dict(state)
        replayed = part(env.state, env.reset_episodes)
        for (path, one), (_, two) in zip(
            _pytree.tree_leaves_with_path(eager), _pytree.tree_leaves_with_path(replayed), strict=True
        ):
            # Contact forces are summed in no fixed order.
            assert torch.allclose(one.float(), two.float(), rtol=1e-4, atol=1e-4, equal_nan=True), path
    assert part.recorded


@pytest.mark.gpu
def test_a_task_that_cannot_be_recorded_runs_on_a_gpu_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    task = tasks.load("in_palm_rotate")
    task = replace(task, rewards={**task.rewards, "waiting": Reward(1.0, _waiting)})
    env = _make(task, {}, device="cuda")
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            reward = env.step(torch.zeros(3, env.num_actions, device="cuda"))[1]
    assert reward.isfinite().all()
    assert torch.rand(1, device="cuda").isfinite().all()
    assert sum("launch by launch" in record.getMessage() for record in caplog.records) == 1
