import gc
import weakref

import numpy as np
import pytest
import torch
from torch import nn

from brainbench.models import proof
from brainbench.models.proof import FIRST, SECOND, Layout, layouts, probes, stimulus_layouts, with_time

STEPS = 6


def _batches(function):
    """Return what a function makes of both batches of probes."""
    stimuli = torch.randn(4, STEPS, 5, generator=torch.Generator().manual_seed(0))
    rows = probes(stimuli, STEPS)
    return [
        function(torch.stack([stimuli[0] if row is None else rows[row].float() for row in batch]))
        for batch in (FIRST, SECOND)
    ]


def _layout(function):
    first, second = _batches(function)
    proven, _ = stimulus_layouts(first, second, (len(FIRST), len(SECOND)))
    layout = proven[0][0]
    return with_time(layout, layout.split(first, len(FIRST)), STEPS), first


@pytest.mark.parametrize(
    ("function", "timed"),
    [
        (lambda x: x, True),
        (lambda x: x.transpose(0, 1), True),
        (lambda x: x.permute(2, 0, 1), True),
        (lambda x: x.flatten(0, 1), True),
        (lambda x: x.transpose(0, 1).flatten(0, 1), True),
        (lambda x: x.transpose(1, 2).flatten(0, 1), True),
        (lambda x: x.transpose(1, 2).flatten(), True),
        (lambda x: x.cumsum(1), True),
        (lambda x: x.flip(1).cumsum(1).flip(1), True),
        (lambda x: x.mean(1), False),
        (lambda x: x.mean(1, keepdim=True).expand(-1, STEPS, -1) * torch.arange(1, STEPS + 1)[:, None], False),
        (
            lambda x: torch.einsum(
                "btf,ts->bsf", x, torch.randn(STEPS, STEPS, generator=torch.Generator().manual_seed(1))
            ),
            False,
        ),
    ],
)
def test_stimuli_and_time_are_proven_in_any_layout(function, timed):
    layout, first = _layout(function)
    rows = layout.rows(first, len(FIRST), STEPS)
    expected = function(_batches(lambda x: x)[0])
    assert rows.shape[:2] == (len(FIRST), STEPS if timed else 1)
    singles = [function(row[None]) for row in _batches(lambda x: x)[0]]
    for row, single in zip(rows, singles, strict=True):
        torch.testing.assert_close(row.flatten().sort().values, single.flatten().sort().values)
    assert rows.numel() == expected.numel()


def test_batch_and_tokens_of_one_number_are_told_apart():
    tokens = torch.randn(STEPS, len(FIRST), 5, generator=torch.Generator().manual_seed(2))
    layout, _ = _layout(lambda x: torch.einsum("btf,tkf->kbf", x, tokens))
    assert layout.axis == 1
    assert layout.time is None


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: torch.ones(16, 3), proof.UNMOVED),
        (lambda x: x.sum(), proof.NO_AXIS),
        (lambda x: x.flatten(1) @ x.flatten(1).T, proof.NO_AXIS),
        (lambda x: x - x.mean(0), proof.DEPENDENT),
        (lambda x: x + torch.arange(len(x))[:, None, None], proof.DEPENDENT),
        (lambda x: x + torch.randn(x.shape), proof.DEPENDENT),
    ],
)
def test_what_is_no_response_has_a_reason(function, reason):
    proven, words = stimulus_layouts(*_batches(function), (len(FIRST), len(SECOND)))
    assert not proven
    assert words == reason


def test_rows_that_do_not_move_are_left_to_the_stimuli():
    proven, _ = stimulus_layouts(*_batches(lambda x: torch.zeros(len(x), 3)), (len(FIRST), len(SECOND)))
    assert [moves for _, moves in proven] == [False]


def test_layouts_are_those_that_both_shapes_allow():
    assert list(layouts((5, 4), (3, 4), (5, 3))) == [Layout(0, rest=(4,))]
    assert list(layouts((10,), (6,), (5, 3))) == [Layout(0, 1, 2), Layout(0, 2, 1)]
    assert not list(layouts((5, 5), (3, 3), (5, 3)))
    assert Layout(1, 2, 3, (4,)).fits((4, 30), 5)
    assert not Layout(1, 2, 3, (4,)).fits((4, 31), 5)


def test_sketches_see_one_entry_that_differs_or_changed_its_place():
    rows = torch.randn(4, 10_000, generator=torch.Generator().manual_seed(3))
    moved, swapped = rows.clone(), rows.clone()
    moved[2, 777] += 3
    swapped[1, [10, 11, 12, 13]] = rows[1, [13, 12, 11, 10]]
    before = proof.sketch(rows)
    assert before.shape == (4, 257)
    assert proof.agree(before, proof.sketch(rows * (1 + 1e-6)), torch.float32)
    assert not proof.agree(before, proof.sketch(moved), torch.float32)
    assert not proof.agree(before, proof.sketch(swapped), torch.float32)
    lost = rows.clone()
    lost[0, 0] = torch.nan
    assert not proof.agree(before, proof.sketch(lost), torch.float32)


@pytest.mark.parametrize(("count", "size"), [(1, 3), (12, 3), (40, 5), (2000, 128)])
def test_the_sample_comes_from_everywhere(count, size):
    sample = proof.draw_sample(count)
    assert len(sample) == size
    assert sample.min() >= 0
    assert sample.max() < count
    if count >= 12:
        assert len(set(sample)) == size
        assert np.ptp(sample) > count / 2


def test_a_copy_is_as_the_model_was():
    model = torch.nn.utils.parametrizations.weight_norm(nn.Linear(3, 2))
    model.held = model.weight * 2  # as old kinds of weight norm keep it
    duplicate = proof.fresh_copy(model)
    torch.testing.assert_close(duplicate(torch.ones(1, 3)), model(torch.ones(1, 3)))
    assert duplicate.held.data_ptr() != model.held.data_ptr()
    model.held = (part for part in ())
    assert proof.fresh_copy(model) is None


def test_a_network_goes_when_nothing_but_its_layers_was_asked_for():
    network = nn.Sequential(nn.Linear(3, 3), nn.Sequential(nn.ReLU()))
    gone = weakref.ref(network)
    gc.disable()
    try:
        assert list(proof.layer_modules(network)) == ["0", "1.0"]
        del network
        assert gone() is None
    finally:
        gc.enable()
