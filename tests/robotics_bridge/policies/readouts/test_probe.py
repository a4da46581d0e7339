"""Read-outs: what is linear in features is found on environments left out, what is not there is not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.training.checkpoints import shipped
from robotics_bridge import hands, tasks
from robotics_bridge.hands.layouts import active_count, write_probes
from robotics_bridge.policies.evaluate import agent
from robotics_bridge.policies.readouts import features
from robotics_bridge.policies.readouts.features import TARGETS, TouchRollout
from robotics_bridge.policies.readouts.probe import (
    ProbeOptions,
    Readout,
    _Elimination,
    choose_taxels,
    differences,
    even_taxels,
    part_of_layout,
    place,
    placements,
    probe,
    read_placements,
    read_targets,
    taxel_features,
)
from robotics_bridge.sensors.probes.placement import Probes


def _made(seed: int = 0, steps: int = 40, envs: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    wanted = torch.randn(steps, envs, 12, generator=generator)
    return torch.randn(steps, envs, 4, generator=generator), wanted, torch.ones(steps, envs, dtype=torch.bool)


def _readout(features: torch.Tensor, proprio: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor) -> Readout:
    errors, spread = read_targets(proprio, features, wanted, valid)
    return Readout("made", features.shape[-1], errors[None], spread)


def test_what_features_hold_is_read_and_what_they_do_not_hold_is_not() -> None:
    proprio, wanted, valid = _made()
    mixed = wanted[..., :6] @ torch.randn(6, 9, generator=torch.Generator().manual_seed(1)) * 1e-4
    found = _readout(mixed, proprio, wanted, valid)
    # Nine mixtures of position and velocity, however small, hold these two and nothing else.
    assert found.r2("position") > 0.99
    assert found.r2("velocity") > 0.99
    assert abs(found.r2("spin")) < 0.05
    assert abs(found.r2("contact")) < 0.05
    low, high = found.interval("position")
    assert low <= found.r2("position") <= high


def test_knowing_the_environment_does_not_help_on_others() -> None:
    proprio, wanted, valid = _made()
    wanted = wanted + 5 * torch.randn(wanted.shape[1], 12, generator=torch.Generator().manual_seed(2))
    place = torch.eye(wanted.shape[1]).expand(len(wanted), -1, -1)
    assert _readout(place, proprio, wanted, valid).r2("position") < 0.05


def test_steps_that_do_not_count_change_nothing() -> None:
    proprio, wanted, valid = _made()
    features = wanted + 0.5 * torch.randn(wanted.shape, generator=torch.Generator().manual_seed(3))
    valid[:10] = False
    first = _readout(features, proprio, wanted, valid)
    spoilt = wanted.clone()
    spoilt[:10] = 1e6
    second = _readout(features, proprio, spoilt, valid)
    np.testing.assert_array_equal(first.errors, second.errors)


def test_an_arm_differs_from_itself_by_nothing_and_draws_widen_the_interval() -> None:
    proprio, wanted, valid = _made()
    one = _readout(wanted + 0.5, proprio, wanted, valid)
    assert one.interval("spin", less=one) == (0.0, 0.0)
    other = _readout(torch.zeros_like(wanted), proprio, wanted, valid)
    both = Readout("both", 12, np.concatenate([one.errors, other.errors]), one.spread)
    low, high = both.interval("spin")
    assert high - low > 0.4
    assert both.per_draw("spin")[0] > 0.99 > 0.1 > both.per_draw("spin")[1]


@pytest.mark.slow
def test_a_rollout_in_a_task_is_read_from_every_arm_of_a_probe() -> None:
    env = tasks.make(
        "in_palm_rotate", num_envs=10, observe="force_torque", placement="tips", resolution="low", threads=1
    )
    names = ("none", "bits", "graph, memory", "reservoir", "simclr")
    own = f"local-dir:{shipped()[f'{features.NETWORK}.simclr']}"
    options = ProbeOptions(seconds=1.0, arms=names, reservoirs=2, networks=("s4-small", own))
    read = probe(env, agent("random", env), options)
    found = {one.arm: one for one in read}
    assert [len(one.errors) for one in found.values()] == [1, 1, 1, 2, 1, 1, 1]
    # A folder of the same weights is the same network.
    assert found[own].r2("position") == found["simclr"].r2("position") != found["s4-small"].r2("position")
    assert {(row["arm"], row["less"]) for row in differences(read)} >= {("s4-small", "reservoir"), (own, "reservoir")}
    assert found["none"].features == 0
    assert all(np.isfinite([one.r2(name) for name in TARGETS]).all() for one in found.values())
    with pytest.raises(UsageError, match="runs without end"):
        probe(env, agent("random", env), ProbeOptions(networks=("zhuang-small+gpt",)))
    with pytest.raises(UsageError, match="observe='force_torque'"):
        probe(tasks.make("in_palm_rotate", num_envs=10, threads=1), agent("zero", env), options)
    with pytest.raises(UsageError, match="at least 10 environments; received 2"):
        probe(tasks.make("in_palm_rotate", num_envs=2, threads=1), agent("zero", env), options)


def test_options_of_a_probe_name_the_culprit() -> None:
    with pytest.raises(UsageError, match="did you mean 'reservoir'"):
        ProbeOptions(arms=("resevoir",))


def _telling(taxels: int = 12, telling: tuple[int, ...] = (3, 7, 8), noise: float = 0.3, envs: int = 20):
    """Targets that three of the taxels mix, one of which (8) tells little beyond another (7)."""
    generator = torch.Generator().manual_seed(0)
    wanted = torch.randn(60, envs, 12, generator=generator)
    features = torch.randn(60, envs, taxels, 4, generator=generator)
    for number, taxel in enumerate(telling):
        part = wanted[..., 4 * number : 4 * number + 4]
        features[:, :, taxel] = part + noise * torch.randn(part.shape, generator=generator)
    return torch.zeros(60, envs, 1), features, wanted, torch.ones(60, envs, dtype=torch.bool)


def test_the_taxels_that_tell_are_chosen_first() -> None:
    proprio, features, wanted, valid = _telling()
    assert set(choose_taxels(proprio, features, wanted, valid, 3)) == {3, 7, 8}


def test_a_taxel_that_repeats_another_is_chosen_last() -> None:
    proprio, features, wanted, valid = _telling()
    features = torch.cat((features, features[:, :, :1] * 0 + features[:, :, 3:4] + 1e-3), 2)
    chosen = choose_taxels(proprio, features, wanted, valid, 4)
    assert not {3, 12} <= set(chosen[:3])


def test_elimination_gains_as_much_as_a_regression_on_all_that_is_chosen() -> None:
    _, features, wanted, valid = _telling(envs=8)
    x = features.flatten(2)
    learning = torch.arange(8) % 4 != 0
    part = _Elimination(x, wanted, valid, learning)
    before = float((1 - part._error / part._spread).mean())
    part.take(slice(12, 16))
    gain = part.gains(0, 12, 4)[7]
    part.take(slice(28, 32))
    after = float((1 - part._error / part._spread).mean())
    rows = [x[:, which][valid[:, which]] for which in (learning, ~learning)]
    aims = [wanted[:, which][valid[:, which]] for which in (learning, ~learning)]
    mean, scale, centre, size = rows[0].mean(0), rows[0].std(0), aims[0].mean(0), aims[0].std(0)
    z = [((one - mean) / scale)[:, [*range(12, 16), *range(28, 32)]].double() for one in rows]
    y = [((one - centre) / size).double() for one in aims]
    weights = torch.linalg.solve(z[0].T @ z[0] / len(z[0]) + torch.eye(8), z[0].T @ y[0] / len(z[0]))
    direct = float((1 - (y[1] - z[1] @ weights).square().sum(0) / y[1].square().sum(0)).mean())
    assert before == 0
    assert after == pytest.approx(direct, abs=1e-5)
    first = torch.linalg.solve(z[0][:, :4].T @ z[0][:, :4] / len(z[0]) + torch.eye(4), z[0][:, :4].T @ y[0] / len(z[0]))
    one = float((1 - (y[1] - z[1][:, :4] @ first).square().sum(0) / y[1].square().sum(0)).mean())
    assert float(gain) == pytest.approx(direct - one, abs=1e-5)


def test_nothing_is_gained_by_choosing_from_noise() -> None:
    # 40 silent taxels of noise: what was chosen on one half must not look better on the other than random ones.
    generator = torch.Generator().manual_seed(1)
    touch = torch.randn(60, 40, 1, 40, 6, generator=generator)
    targets = {
        name: torch.randn(60, 40, 3, generator=generator) for name in ("position", "velocity", "spin", "contact")
    }
    begun = torch.zeros(60, 40, dtype=torch.bool)
    rollout = TouchRollout(torch.zeros(60, 40, 1), touch, begun, targets, ~begun, torch.empty(0))
    layout = {"link": Probes(np.zeros((40, 3)), np.tile([0.0, 0.0, 1.0], (40, 1)), np.full(40, 1e-3), (40,))}
    found = {one.name: one.readout for one in read_placements(rollout, layout, 10, draws=3)}
    assert abs(found["chosen"].r2("position") - found["random"].r2("position")) < 0.02


def test_chosen_taxels_are_read_on_environments_that_did_not_choose_them(monkeypatch) -> None:
    seen = []
    choose = choose_taxels

    def watched(proprio, features, wanted, valid, count):
        seen.append(float(wanted.mean()))
        return choose(proprio, features, wanted, valid, count)

    monkeypatch.setattr("robotics_bridge.policies.readouts.probe.choose_taxels", watched)
    begun = torch.zeros(30, 20, dtype=torch.bool)
    half = (torch.arange(20) >= 10).float()[None, :, None].expand(30, 20, 3)
    targets = {name: half + 0.01 * torch.randn(30, 20, 3) for name in ("position", "velocity", "spin", "contact")}
    rollout = TouchRollout(torch.zeros(30, 20, 1), torch.randn(30, 20, 1, 8, 6), begun, targets, ~begun, torch.empty(0))
    layout = {"link": Probes(np.zeros((8, 3)), np.tile([0.0, 0.0, 1.0], (8, 1)), np.full(8, 1e-3), (8,))}
    found = {one.name: one for one in read_placements(rollout, layout, 2, draws=1)}
    # The first half (targets near 0) is read from what the second (near 1) chose, and the other way round.
    assert seen == pytest.approx([1.0, 0.0], abs=0.05)
    first, second = found["chosen"].taxels
    features = taxel_features(rollout)
    reading = [read_targets(rollout.proprio[:, part], features[:, part][:, :, list(taxels)].flatten(2),
                            rollout.wanted[:, part], rollout.valid[:, part])[0]
               for part, taxels in ((slice(0, 10), first), (slice(10, 20), second))]  # fmt: skip
    np.testing.assert_allclose(found["chosen"].readout.errors[0], np.concatenate(reading))


def test_even_taxels_are_the_share_of_every_link_far_apart() -> None:
    layout = hands.load("xhand1").layout("med", "hand")
    found = even_taxels(layout, 50)
    assert len(set(found)) == 50
    owner = np.repeat(np.arange(len(layout)), [active_count({"": one}) for one in layout.values()])
    counts = np.bincount(owner[found], minlength=len(layout))
    share = 50 * np.bincount(owner) / len(owner)
    assert (np.abs(counts - share) < 1).all()
    points = np.concatenate([one.position[one.active] for one in layout.values()])
    palm = points[[one for one in found if owner[one] == 0]]
    gaps = np.linalg.norm(palm[:, None] - palm[None], axis=-1) + np.eye(len(palm))
    every = points[owner == 0]
    neighbours = np.linalg.norm(every[:, None] - every[None], axis=-1) + np.eye(len(every))
    assert gaps.min() > 1.3 * neighbours.min()


def test_a_chosen_layout_is_one_that_a_task_can_feel_with(tmp_path) -> None:
    layout = hands.load("xhand1").layout("med", "hand")
    part = part_of_layout(layout, [0, 40, 198])
    assert active_count(part) == 3
    points = np.concatenate([one.position[one.active] for one in layout.values()])
    np.testing.assert_array_equal(
        np.concatenate([one.position[one.active] for one in part.values()]), points[[0, 40, 198]]
    )
    write_probes(tmp_path / "three.json", part)
    env = tasks.make("in_palm_rotate", observe="force_torque", resolution=str(tmp_path / "three.json"), threads=1)
    assert env.observation_shapes["tactile"][-2:] == (3, 6)


def test_a_hand_is_placed_from_one_rollout(tmp_path) -> None:
    env = tasks.make("in_palm_rotate", num_envs=20, observe="force_torque", resolution="low", threads=1)
    found, layout = place(env, agent("random", env), ProbeOptions(seconds=0.5, place=4, draws=2))
    told = placements(found)
    rows = {one["arm"]: one for one in told["arms"]}
    assert {name: rows[name]["taxels"] for name in ("none", "all", "even", "random", "chosen", "tips")} == {
        "none": 0, "all": 90, "even": 4, "random": 4, "chosen": 4, "tips": 45,
    }  # fmt: skip
    assert rows["random"]["draws"] == 2
    assert {one["arm"] for one in told["differences"]} == set(rows) - {"all"}
    assert active_count(layout) == 4
    with pytest.raises(UsageError, match=r"taxels .*at least 1 and at most 90; received 91"):
        place(env, agent("random", env), ProbeOptions(seconds=0.5, place=91))
    small = tasks.make("in_palm_rotate", num_envs=10, observe="force_torque", resolution="low", threads=1)
    with pytest.raises(UsageError, match=r"environments of a probe .*at least 20; received 10"):
        place(small, agent("random", small), ProbeOptions(seconds=0.5, place=4))


def test_a_probe_places_taxels_or_compares_arms() -> None:
    with pytest.raises(UsageError, match="received both"):
        ProbeOptions(place=50, arms=("reservoir",))
    with pytest.raises(UsageError, match=r"draws of a probe .*received 0"):
        ProbeOptions(draws=0)
