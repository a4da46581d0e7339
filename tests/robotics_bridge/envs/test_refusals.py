"""Options, seeds, actions and states that do not fit are refused; one seed gives one course of events."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import EnvOptions
from robotics_bridge.hands import load
from robotics_bridge.hands.observations import observe, sensors_for
from robotics_bridge.hands.surface import cast_grid


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", 1.5), ("seed", -1), ("seed", np.nan), ("seed", 2**70), ("threads", 0), ("threads", -1),
        ("placement", "tps"), ("resolution", "hi"), ("noisy", True), ("knobs", {"points": 5}),
        ("device", torch.device("cpu")),
    ],
)  # fmt: skip
def test_options_have_ranges_and_are_not_ignored(name, value) -> None:
    with pytest.raises(UsageError, match=name):
        EnvOptions(**{name: value})


def _course(env, seed: int) -> list[torch.Tensor]:
    env.seed(seed)
    observations = env.reset()
    actions = torch.Generator().manual_seed(0)
    seen = [value.clone() for value in observations.values()]
    for _ in range(4):
        step = env.step(0.5 * torch.randn(2, env.num_actions, generator=actions))
        seen += [*(value.clone() for value in step[0].values()), step[1].clone()]
    return seen


def test_one_seed_gives_one_course_with_noisy_touch_too() -> None:
    options = {"num_envs": 2, "observe": "depth", "noisy": True, "resolution": "low", "threads": 1}
    env, other = (tasks.make("in_palm_rotate", seed=seed, **options) for seed in (0, 9))
    first = _course(env, 5)
    for again in (_course(env, 5), _course(other, 5)):
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, _course(env, 6), strict=True))
    # A kept state brings the seed of its noise along.
    action, kept = torch.zeros(2, env.num_actions), env.state_dict()
    fresh = tasks.make("in_palm_rotate", seed=3, **options)
    fresh.load_state_dict(kept)
    for one in (env, fresh):
        one.reset()
    assert torch.equal(env.step(action)[0]["tactile"], fresh.step(action)[0]["tactile"])


def test_what_does_not_fit_the_environments_is_refused() -> None:
    one, two = (tasks.make("in_palm_rotate", num_envs=count, threads=1) for count in (1, 2))
    for seed in (np.nan, 1.5, -1, 2**70, None):
        with pytest.raises(UsageError, match="seed"):
            two.seed(seed)
    with pytest.raises(UsageError, match="tensor"):
        two.step(np.zeros((2, two.num_actions), np.float32))
    for mask in (np.array([True, False]), torch.tensor([1, 0]), torch.tensor([True])):
        with pytest.raises(UsageError, match="mask"):
            two.reset(mask)
    for values in ({}, one.state_dict()):
        with pytest.raises(UsageError, match="other environments"):
            two.load_state_dict(values)
    two.load_state_dict(two.state_dict())
    with pytest.raises(UsageError, match=r"\(2,\)"):
        two.episode_length_buf = torch.zeros(1, dtype=torch.long)


def test_an_option_that_a_reset_in_gymnasium_lacks_is_refused() -> None:
    pytest.importorskip("gymnasium")
    from robotics_bridge.envs.gymnasium import make_vec

    envs = make_vec("in_palm_rotate", 2)
    with pytest.raises(UsageError, match="reset_mask"):
        envs.reset(options={"reset_masks": [True, False]})
    envs.reset(seed=3, options={"reset_mask": [True, False]})


def test_readings_have_the_shape_of_their_type() -> None:
    layout = load("xhand1").layout("low", "tips")
    for name, wrong in (("force", ()), ("bool", (6,)), ("depth", (2,)), ("force", (3,))):
        readings = {link: torch.zeros(2, len(probes), *wrong) for link, probes in layout.items()}
        with pytest.raises(UsageError, match="shape"):
            observe(name, readings, layout)
    swapped = {link: torch.zeros(2, 6, len(probes)) for link, probes in layout.items()}
    with pytest.raises(UsageError, match="shape"):
        observe("force", swapped, layout)
    with pytest.raises(UsageError, match="at least one link"):
        observe("force", {}, {})
    assert observe("depth", {link: torch.zeros(0, len(p)) for link, p in layout.items()}, layout).shape[0] == 0


def test_settings_of_sensors_are_known_and_layouts_hold_probes() -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match="did you mean 'stiffness'"):
        sensors_for("force", hand.layout("low", "tips"), stifness=3)
    for layout in ({}, {hand.palm: np.zeros((1, 3))}):
        with pytest.raises(UsageError, match="layout"):
            hand.with_probes(layout)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("facing", (0, 0, 0)),
        ("facing", (np.nan, 0, 1)),
        ("extent", -1.0),
        ("extent", np.nan),
        ("rows", 0),
        ("rows", 1.5),
    ],
)  # fmt: skip
def test_grids_are_cast_by_numbers(name, value) -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match=name):
        cast_grid(hand.model, hand.palm, **{"rows": 2, "columns": 2, "facing": (1, 0, 0), "radius": 0.004, name: value})
