"""Trainings and records meet by network and seed; damaged files are refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from leaderboards.reproduction.campaign import NetworkKey, board_name, join_campaign, read_campaign
from leaderboards.reproduction.measures import accuracies, fits
from tests.factories.campaigns import draw_campaign, draw_records, draw_trainings, write_campaign


def test_trainings_and_records_of_a_folder_meet(tmp_path):
    lines, records = draw_trainings(1), draw_records(1)
    campaign = read_campaign(write_campaign(tmp_path / "campaign", lines, records))
    assert set(campaign.baselines) == {"raw-input", "random-features"}
    assert sum(len(one.trainings) for one in campaign.networks.values()) == len(lines) - 2
    for network in campaign.networks.values():
        assert set(network.trainings) == set(network.records[0])
        assert {line.model for line in network.trainings.values()} == {
            one.card.twin for one in network.records[0].values()
        }
    assert NetworkKey("zhuang-gru", "none", "simclr", "masked") in campaign.networks
    assert NetworkKey("zhuang-gru", "none", "simclr", "image") in campaign.networks
    assert board_name(campaign.boards[0]).startswith("demo")


@pytest.mark.parametrize(
    "name", ["zhuang-gru-small+gpt.supervised.seed1", "local-dir:/runs/zhuang-gru-small+gpt.supervised.seed1"]
)
def test_a_record_without_card_is_known_by_its_name(name):
    record = next(one for one in draw_records(1) if one.score.name == "zhuang-gru-small+gpt.supervised")
    bare = replace(record, card=None, score=replace(record.score, name=name))
    campaign = join_campaign([], [bare])
    network = campaign.networks[NetworkKey("zhuang-gru", "gpt", "supervised")]
    assert list(network.records[0]) == [1]
    odd = join_campaign([], [replace(bare, score=replace(bare.score, name="features.npz"))])
    assert not odd.networks
    assert odd.unmatched == ("features.npz",)


def test_of_one_network_and_seed_the_newest_record_counts():
    record = draw_records(1)[0]
    told = {**record.score.provenance, "time": "2027-01-01T00:00:00+00:00"}
    newer = replace(record, score=replace(record.score, value=0.9, provenance=told))
    for order in ([record, newer], [newer, record]):
        campaign = join_campaign([], order)
        (network,) = campaign.networks.values()
        assert network.records[0][0].score.value == 0.9


def test_networks_of_published_size_enter_no_comparison():
    lines = draw_campaign(1).trainings
    full = replace(lines[0], name="full", model="zhuang+gpt", evaluation=lines[0].evaluation)
    campaign = join_campaign([*lines, full], [])
    assert campaign.other_sizes == ("zhuang+gpt",)
    assert "full" not in {line.name for line in campaign.trainings}


def test_twins_stand_in_for_untrained_networks():
    lines = draw_campaign(1).trainings
    alone = [line for line in lines if line.objective == "simclr"][:1]
    twin = replace(alone[0], twin_evaluation=replace(alone[0].evaluation, top5=0.11, top1=0.05))
    found = accuracies(join_campaign([twin], [])).find(objective="untrained")
    assert [item.value for item in found.values()] == [0.11]


def test_unreliable_scores_are_left_out():
    record = draw_records(1)[0]
    doubtful = replace(record, score=replace(record.score, status="unreliable"))
    assert not fits(join_campaign([], [doubtful]), 0).networks
    assert fits(join_campaign([], [record]), 0).networks


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"objective": "supervized"}, "supervised"),
        ({"evaluation": {"top1": 0.5, "top5": 0.4, "count": 10}}, "top-5 0.4"),
        ({"evaluation": {"top1": "high", "top5": 0.4, "count": 10}}, "top1"),
        ({"model": ""}, "model"),
        ({"data": {"hash": "abcd", "classes": 7}}, "'7'"),
        ({"seed": "first"}, "seed"),
    ],
)
def test_a_bad_line_is_named(tmp_path, change, told):
    lines = draw_trainings(1)[:3]
    folder = write_campaign(tmp_path / "campaign", [*lines[:2], {**lines[2], **change}])
    with pytest.raises((DataError, UsageError)) as caught:
        read_campaign(folder)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_repeated_lines_broken_json_and_empty_folders_are_refused(tmp_path):
    lines = draw_trainings(1)[:2]
    with pytest.raises(DataError, match="repeats"):
        read_campaign(write_campaign(tmp_path / "twice", [lines[0], lines[0]]))
    with pytest.raises(DataError, match="same network and seed"):
        read_campaign(write_campaign(tmp_path / "same", [lines[0], {**lines[0], "name": "again"}]))
    folder = write_campaign(tmp_path / "cut", lines)
    text = (folder / "trainings.jsonl").read_text()
    (folder / "trainings.jsonl").write_text(text[:-40])
    with pytest.raises(DataError, match="Line 2"):
        read_campaign(folder)
    (folder / "trainings.jsonl").write_text(json.dumps([1]) + "\n")
    with pytest.raises(DataError, match="Line 1"):
        read_campaign(folder)
    with pytest.raises(DataFileNotFoundError, match="nowhere"):
        read_campaign(tmp_path / "nowhere")


def test_a_damaged_record_is_refused(tmp_path):
    folder = write_campaign(tmp_path / "campaign", [], draw_records(1)[:2])
    path = next((folder / "records").iterdir())
    path.write_text(path.read_text().replace('"ok"', '"OK"', 1))
    with pytest.raises(DataError, match=r"OK|edited"):
        read_campaign(folder)


def test_a_folder_of_weights_is_known_by_its_card_and_gets_the_accuracies_of_its_training():
    record = next(one for one in draw_records(1) if one.score.name == "zhuang-gru-small+gpt.supervised")
    card = replace(record.card, top1=None, top5=None, augmentation="physical + 75% masking", training={"masking": 0.75})
    moved = replace(record, card=card, score=replace(record.score, name="local-dir:/runs/17/best"))
    key = NetworkKey("zhuang-gru", "gpt", "supervised")
    line = draw_campaign(1).networks[key].trainings[card.seed]
    twin = replace(line.evaluation, top1=0.05, top5=0.1)
    campaign = join_campaign([replace(line, masking=0.75, twin_evaluation=twin)], [moved])
    assert list(campaign.networks) == [key._replace(variant="masked")]
    (entry,) = campaign.boards[0].entries
    assert (entry.card.top5, entry.card.twin_top1) == (line.evaluation.top5, 0.05)
    lost = join_campaign([replace(line, masking=0.75, status="diverged")], [moved])
    assert lost.boards[0].entries[0].card.top5 is None
    assert not fits(lost, 0).networks


def test_a_training_at_a_given_rate_stands_beside_the_one_whose_rate_was_searched():
    key = NetworkKey("zhuang-gru", "gpt", "supervised")
    line = draw_campaign(1).networks[key].trainings[0]
    higher = replace(line, name=f"{line.name}.rate", rate=0.01, evaluation=replace(line.evaluation, top5=0.5))
    found = accuracies(join_campaign([line, higher], [])).networks
    assert found[key].seeds == {0: line.evaluation.top5}
    assert found[key._replace(variant="rate 0.01")].seeds == {0: 0.5}
