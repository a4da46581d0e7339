"""The processes of a run: one alone needs nobody, and several on the CPU share no batch norm."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.training.batches import (
    KINDS,
    LAST_COLUMNS,
    Augmentation,
    Processes,
    SampledAugmentation,
    flip,
    mask_steps,
    processes,
    reverse_time,
)

OCCUPIED = torch.tensor([[column <= last for column in range(7)] for last in LAST_COLUMNS])


def _sweeps(batch=4, steps=6, sub_steps=5):
    return torch.randn(batch, steps, 6 * sub_steps, 5, 7) * OCCUPIED


def _generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_the_mouse_has_thirty_whiskers():
    assert OCCUPIED.sum() == 30


@pytest.mark.parametrize(("direction", "axis"), [("vertical", 2), ("horizontal", 1)])
def test_forces_and_moments_are_those_of_the_mirrored_scene(direction, axis):
    # A force F at the lever arm r has the moment r × F; mirror r and F and take the moment again.
    arm, force = torch.randn(3, dtype=torch.float64), torch.randn(3, dtype=torch.float64)
    mirror = torch.ones(3, dtype=torch.float64)
    mirror[axis] = -1
    wrench = torch.cat((force, torch.linalg.cross(arm, force)))
    mirrored = torch.cat((mirror * force, torch.linalg.cross(mirror * arm, mirror * force)))
    x = wrench.view(1, 1, 6, 1, 1).expand(1, 1, 6, 5, 7) * OCCUPIED
    torch.testing.assert_close(flip(x, direction)[0, 0, :, 2, 3], mirrored)


@pytest.mark.parametrize(("direction", "axis"), [("vertical", 2), ("horizontal", 1)])
def test_follicle_axes_are_mirrored_with_their_whisker(direction, axis):
    arm, force = torch.randn(3, dtype=torch.float64), torch.randn(3, dtype=torch.float64)
    pose = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    pose *= torch.linalg.det(pose)
    mirror = torch.eye(3, dtype=torch.float64)
    mirror[axis, axis] = -1
    # Whisker and plane of curvature are mirrored; the third axis completes them to a right-handed frame again.
    partner = mirror @ pose @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    wrench = torch.cat((pose.T @ force, pose.T @ torch.linalg.cross(arm, force)))
    moment = torch.linalg.cross(mirror @ arm, mirror @ force)
    x = wrench.view(1, 1, 6, 1, 1).expand(1, 1, 6, 5, 7) * OCCUPIED
    found = flip(x, direction, axes="follicle")[0, 0, :, 2, 3]
    torch.testing.assert_close(found, torch.cat((partner.T @ mirror @ force, partner.T @ moment)))


def test_whiskers_go_where_the_mirror_takes_them():
    x = torch.zeros(1, 1, 6, 5, 7)
    x[0, 0, 0, 0, 0] = 1.0  # Fx of A0, tangential to both mirrors
    x[0, 0, 0, 2, 6] = 2.0  # and of C6
    up = flip(x, "vertical")[0, 0, 0]
    assert (up[4, 0], up[3, 6]) == (1.0, 2.0)  # E0; column 6 has C and D alone
    along = flip(x, "horizontal")[0, 0, 0]
    assert (along[0, 4], along[2, 0]) == (1.0, 2.0)  # A4, the last of its row; C0


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.sampled_from(["vertical", "horizontal"]))
def test_a_flip_loses_nothing_keeps_empty_cells_empty_and_undoes_itself(seed, direction):
    x = torch.randn(2, 3, 30, 5, 7, generator=_generator(seed)) * OCCUPIED
    y = flip(x, direction)
    assert not y[..., ~OCCUPIED].any()
    torch.testing.assert_close(y.flatten(3).abs().sort().values, x.flatten(3).abs().sort().values)
    assert torch.equal(flip(y, direction), x)


@pytest.mark.parametrize("direction", ["vertical", "horizontal"])
@pytest.mark.parametrize(
    "cells", [(14, 15, 16, 17), (0, 2, 28, 33), (29, 30, 31, 32, 33, 34)], ids=["C0-C3", "A", "rat E"]
)
def test_whiskers_of_a_part_of_the_array_change_places_with_one_another_alone(direction, cells):
    held = torch.zeros(35).index_fill(0, torch.tensor(cells), 1.0).view(5, 7)
    x = torch.randn(64, 3, 30, 5, 7) * held
    y = flip(x, direction, cells)
    assert not y[..., held == 0].any()
    torch.testing.assert_close(y.flatten(3).abs().sort().values, x.flatten(3).abs().sort().values)
    assert not Augmentation("physical", cells=cells)(x, _generator())[..., held == 0].any()


def test_time_runs_backwards_sub_step_by_sub_step():
    x = torch.arange(6.0 * 5).view(1, 6, 5, 1, 1, 1).expand(1, 6, 5, 6, 5, 7).reshape(1, 6, 30, 5, 7)
    y = reverse_time(x).unflatten(2, (5, 6))[0, :, :, 0, 0, 0].flatten()
    assert y.tolist() == list(reversed(range(30)))
    assert torch.equal(reverse_time(reverse_time(x)), x)


def test_every_sample_has_its_own_draw():
    x = _sweeps(1).expand(64, -1, -1, -1, -1)
    y = Augmentation("physical")(x, _generator())
    assert len({tuple(row.flatten().tolist()) for row in y}) == 8


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "image"])
def test_augmentations_neither_add_nor_scale(kind):
    x = _sweeps(32)
    before, y = x.clone(), Augmentation(kind)(x, _generator(3))
    assert torch.equal(x, before)
    assert y.shape == x.shape
    assert y.abs().amax() <= x.abs().amax()


def test_physical_augmentation_keeps_the_signal_and_the_empty_cells():
    x = _sweeps(32)
    y = Augmentation("physical")(x, _generator())
    torch.testing.assert_close(y.flatten(1).norm(dim=1), x.flatten(1).norm(dim=1))
    assert not y[..., ~OCCUPIED].any()


def test_the_published_form_draws_once_per_batch_and_loses_cells():
    x = torch.ones(3, 4, 30, 5, 7)
    shares = set()
    for seed in range(20):
        y = Augmentation("thesis")(x, _generator(seed))
        assert torch.equal(y[0], y[1])
        shares.add(round(1 - float(y.mean()), 3))
    assert shares == {0.0, 0.286}


def test_the_published_form_turns_the_grid_and_not_the_vectors():
    x, found = torch.zeros(1, 1, 6, 5, 7), set()
    x[0, 0, 2, 0, 3] = 1.0  # Fz at the middle of the first row
    for seed in range(40):
        y = Augmentation("thesis")(x, _generator(seed))
        assert y[0, 0, 2].sum() == 1.0
        found.add(tuple(y[0, 0, 2].nonzero()[0].tolist()))
    assert found == {(0, 3), (4, 3), (2, 1), (2, 5)}


def test_the_image_form_changes_values_differently_for_every_sample():
    x = 1e-4 * _sweeps(1).expand(16, -1, -1, -1, -1)
    y = Augmentation("image")(x, _generator())
    assert torch.isfinite(y).all()
    assert len({tuple(row.flatten().tolist()) for row in y}) > 8
    silent = Augmentation("image")(torch.zeros(2, 3, 30, 5, 7), _generator())
    assert not silent.any()


def test_masking_silences_whole_steps_of_each_sample():
    x = torch.ones(8, 20, 6, 5, 7)
    y = mask_steps(x, 0.75, SampledAugmentation(_generator()))
    kept = y.flatten(2).mean(2)
    assert set(kept.unique().tolist()) == {0.0, 1.0}
    assert (kept.sum(1) == 5).all()
    assert len({tuple(row.tolist()) for row in kept}) > 1
    assert mask_steps(x[:, :2], 0.9, SampledAugmentation(_generator())).any()


def test_equal_generators_give_equal_results():
    x, augmentation = _sweeps(), Augmentation("physical", masking=0.5)
    assert torch.equal(augmentation(x, _generator(5)), augmentation(x, _generator(5)))


def test_wrong_choices_are_refused():
    with pytest.raises(UsageError, match=r"'physicl'.*'physical'"):
        Augmentation("physicl")
    with pytest.raises(UsageError, match=r"received 1\.0"):
        Augmentation("none", masking=1.0)
    with pytest.raises(UsageError, match=r"received \[1, 1, 5, 5, 7\]"):
        flip(torch.zeros(1, 1, 5, 5, 7), "vertical")
    with pytest.raises(UsageError, match="flip 'sideways'"):
        flip(torch.zeros(1, 1, 6, 5, 7), "sideways")


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_part_of_a_batch_is_treated_as_in_the_whole(kind):
    x, augmentation = _sweeps(8), Augmentation(kind, masking=0.3)
    whole = augmentation(x, _generator(7))
    for rank in range(2):
        part = augmentation(x[rank::2], _generator(7), part=(rank, 2))
        torch.testing.assert_close(part, whole[rank::2])


def test_one_process_is_the_first_and_keeps_its_own_numbers(monkeypatch):
    for name in ("WORLD_SIZE", "RANK"):
        monkeypatch.delenv(name, raising=False)
    with processes("cpu") as alone:
        assert (alone.part, alone.first, alone.device) == ((0, 1), True, torch.device("cpu"))
        assert alone.mean(0.25) == 0.25
        assert alone.any(True, False) == (True, False)
        alone.wait()
    assert not torch.distributed.is_initialized()


def test_batch_norms_are_refused_where_processes_cannot_pool_them():
    normed, plain = nn.Sequential(nn.Linear(3, 3), nn.BatchNorm1d(3)), nn.Linear(3, 3)
    second = Processes(1, 2, torch.device("cpu"))
    assert not second.first
    assert second.prepare(plain) is plain
    with pytest.raises(UsageError, match="batch norms in one process"):
        second.prepare(normed)
    assert Processes(0, 1, torch.device("cpu")).prepare(normed) is normed


def test_shares_of_a_batch_average_to_the_whole(monkeypatch):
    # Stands in for the sum over processes: the other one holds three times as much.
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda vector: vector.mul_(4))
    share = Processes(0, 2, torch.device("cpu"))
    gradient = torch.tensor([1.0, -2.0])
    share.average(gradient)
    assert gradient.tolist() == [2.0, -4.0]
    assert share.mean(0.5) == 1.0
