from __future__ import annotations

import json
import os
import signal
import threading

import pytest
import torch
from safetensors.torch import save_file

from brainbench.core.errors import DataError, UsageError
from brainbench.core.runs.folder import (
    Stop,
    begin_run,
    claim,
    learner_state,
    load_state,
    mark,
    occupied,
    random_state,
    restore_learner,
    save_state,
    set_random_state,
)


def _claim(folder, identity, **changes):
    claim(folder / "run.json", identity, lambda: {"run": identity}, stated=lambda document: document["run"], **changes)


def test_a_folder_holds_one_run(tmp_path):
    _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.1}})
    _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.1}})
    with pytest.raises(UsageError, match=r"another run: rate\.first 0\.1 \(now 0\.2\)"):
        _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.2}})
    with pytest.raises(UsageError, match=r"rate\.first 0\.1 \(now None\)"):
        _claim(tmp_path / "a", {"seed": 0, "rate": {}})


def test_all_processes_but_one_leave_a_folder_without_a_run_as_it_is(tmp_path):
    _claim(tmp_path / "a", {"seed": 0}, write=False)
    assert not (tmp_path / "a").exists()


def test_more_can_be_said_of_a_run(tmp_path):
    _claim(tmp_path, {"seed": 0})
    mark(tmp_path / "run.json", status="finished")
    assert json.loads((tmp_path / "run.json").read_text()) == {"run": {"seed": 0}, "status": "finished"}


def test_a_folder_of_something_else_is_not_taken_for_a_run(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"holds no data set \(it has 'thesis\.tex'\)"):
        begin_run(tmp_path, {"seed": 0}, "data set", results="*.h5")


def _make_training(width=3):
    torch.manual_seed(0)
    model = torch.nn.Linear(width, 2)
    return model, torch.optim.AdamW(model.parameters(), lr=0.1)


def _step(model, optimizer):
    optimizer.zero_grad()
    model(torch.randn(4, model.in_features)).square().mean().backward()
    optimizer.step()


def test_trees_of_tensors_and_numbers_survive_a_file(tmp_path):
    tree = {"a": torch.arange(3), "b": [1.5, None, (torch.ones(2, 2), "x")], "state": {0: {"step": torch.tensor(2.0)}}}
    save_state(tmp_path / "tree.safetensors", tree)
    back = load_state(tmp_path / "tree.safetensors")
    assert torch.equal(back["a"], tree["a"])
    assert back["b"][:2] == [1.5, None]
    assert isinstance(back["b"][2], tuple)
    assert torch.equal(back["b"][2][0], torch.ones(2, 2))
    assert float(back["state"][0]["step"]) == 2.0


def test_a_training_goes_on_to_the_last_bit(tmp_path):
    model, optimizer = _make_training()
    _step(model, optimizer)
    device = torch.device("cpu")
    save_state(tmp_path / "state", {**learner_state(model, optimizer), "random": random_state(device)})
    _step(model, optimizer)

    resumed, moments = _make_training()
    state = load_state(tmp_path / "state")
    restore_learner(state, resumed, moments, tmp_path / "state")
    set_random_state(state["random"], device)
    _step(resumed, moments)
    assert torch.equal(resumed.weight, model.weight)


def test_states_that_do_not_fit_or_are_damaged_are_refused(tmp_path):
    model, optimizer = _make_training()
    _step(model, optimizer)
    path = tmp_path / "state.safetensors"
    save_state(path, learner_state(model, optimizer))
    with pytest.raises(DataError, match=r"belongs to another network .*Delete it to start anew"):
        restore_learner(load_state(path), *_make_training(5), path)
    state = load_state(path)
    state["optimizer"]["state"][0]["exp_avg"] = torch.zeros(7)
    with pytest.raises(DataError, match=r"'exp_avg' of the optimiser .*fits no weights"):
        restore_learner(state, *_make_training(), path)
    state["learner"]["weight"][0, 0] = torch.nan
    with pytest.raises(DataError, match="not finite"):
        restore_learner(state, *_make_training(), path)
    path.write_bytes(b"no tensors")
    with pytest.raises(DataError, match=r"state\.safetensors"):
        load_state(path)


def test_a_state_of_another_format_is_refused_in_one_sentence(tmp_path):
    save_file({"learner.weight": torch.zeros(2)}, tmp_path / "state.safetensors", {"state": json.dumps({"plain": {}})})
    with pytest.raises(DataError, match=r"state\.safetensors.*Delete it to start anew"):
        load_state(tmp_path / "state.safetensors")


def test_a_run_stops_after_its_time_or_at_its_count():
    assert Stop().reason(10**6) == ""
    assert Stop(0.0).reason() == "the 0 s allowed are over; start it again to go on"
    counted = Stop(count=3, counted="iterations")
    assert [bool(counted.reason(done)) for done in (2, 3)] == [False, True]
    with pytest.raises(UsageError, match="stop_after must be a finite number, at least 0; received nan"):
        Stop(float("nan"))


def test_sigterm_asks_a_run_to_stop_and_means_the_end_again_afterwards(tmp_path):
    before, stop = signal.getsignal(signal.SIGTERM), Stop()
    with occupied(tmp_path, stop):
        os.kill(os.getpid(), signal.SIGTERM)
        assert "SIGTERM" in stop.reason()
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_in_another_thread_listens_to_no_signal(tmp_path):
    before, seen = signal.getsignal(signal.SIGTERM), []

    def run():
        with occupied(tmp_path, Stop()):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [before]


def test_a_folder_has_one_run_at_a_time(tmp_path):
    with occupied(tmp_path, Stop()), pytest.raises(UsageError, match="Another process"), occupied(tmp_path, Stop()):
        pass
