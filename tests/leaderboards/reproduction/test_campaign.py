"""Trainings and records meet by network and seed; damaged files are refused in one sentence."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from tests.factories.benchmark_programs import benchmark_program
from tests.factories.campaigns import draw_campaign, draw_records, draw_trainings, write_campaign

CAMPAIGN, MEASURES = benchmark_program("reproduction.campaign"), benchmark_program("reproduction.measures")
NetworkKey, join_campaign, read_campaign = CAMPAIGN.NetworkKey, CAMPAIGN.join_campaign, CAMPAIGN.read_campaign
accuracies, fits = MEASURES.accuracies, MEASURES.fits


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
    assert CAMPAIGN.board_name(campaign.boards[0]).startswith("demo")


def test_a_record_that_does_not_say_what_was_trained_is_refused():
    record = draw_records(1)[0]
    for card in (None, replace(record.card, objective=None), replace(record.card, twin=None)):
        with pytest.raises(DataError, match=record.score.name):
            join_campaign([], [replace(record, card=card)])


def test_two_records_of_one_network_and_seed_are_refused():
    record = draw_records(1)[0]
    with pytest.raises(DataError, match="same network and seed"):
        join_campaign([], [record, replace(record, score=replace(record.score, value=0.9))])


def test_networks_of_published_size_enter_no_comparison():
    lines = draw_campaign(1).trainings
    full = replace(lines[0], name="full", model="zhuang+gpt", evaluation=lines[0].evaluation)
    campaign = join_campaign([*lines, full], [])
    assert [key.name for key in campaign.full] == ["zhuang+gpt.ae"]
    assert "full" not in {line.name for line in campaign.trainings}


def test_unreliable_scores_are_left_out():
    record = draw_records(1)[0]
    doubtful = replace(record, score=replace(record.score, status="unreliable"))
    assert not fits(join_campaign([], [doubtful]), 0).networks
    assert fits(join_campaign([], [record]), 0).networks


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"objective": "supervized"}, "supervized"),
        ({"evaluation": {"top1": 0.5, "top5": 1.4, "count": 10}}, "top5"),
        ({"evaluation": {"top1": "high", "top5": 0.4, "count": 10}}, "top1"),
        ({"data": {"hash": "efgh"}}, "efgh"),
        ({"seed": "first"}, "seed"),
    ],
)
def test_a_bad_line_is_named(tmp_path, change, told):
    lines = draw_trainings(1)[:3]
    folder = write_campaign(tmp_path / "campaign", [*lines[:2], {**lines[2], **change}])
    with pytest.raises((DataError, msgspec.ValidationError), match=told):
        read_campaign(folder)


def test_repeated_lines_broken_json_and_empty_folders_are_refused(tmp_path):
    lines = draw_trainings(1)[:2]
    with pytest.raises(DataError, match="same network and seed"):
        read_campaign(write_campaign(tmp_path / "same", [lines[0], {**lines[0], "name": "again"}], draw_records(1)[:1]))
    folder = write_campaign(tmp_path / "cut", lines)
    text = (folder / "trainings.jsonl").read_text()
    (folder / "trainings.jsonl").write_text(text[:-40])
    with pytest.raises(msgspec.DecodeError):
        read_campaign(folder)
    (folder / "trainings.jsonl").write_text("")
    with pytest.raises(DataFileNotFoundError, match="records"):
        read_campaign(folder)


def test_a_damaged_record_is_refused(tmp_path):
    folder = write_campaign(tmp_path / "campaign", [], draw_records(1)[:2])
    path = next((folder / "records").iterdir())
    path.write_text(path.read_text().replace('"ok"', '"OK"', 1))
    with pytest.raises(DataError, match=r"OK|edited"):
        read_campaign(folder)


def test_a_folder_of_weights_is_known_by_its_card_and_gets_the_accuracies_of_its_training():
    record = next(one for one in draw_records(1) if one.score.name == "zhuang-gru-small+gpt.supervised")
    card = replace(record.card, top1=None, top5=None, augmentation="none + 75% masking", training={"masking": 0.75})
    moved = replace(record, card=card, score=replace(record.score, name="local-dir:/runs/17/best"))
    key = NetworkKey("zhuang-gru", "gpt", "supervised")
    line = draw_campaign(1).networks[key].trainings[card.seed]
    twin = replace(line.evaluation, top1=0.05, top5=0.1)
    drawn = replace(line, objective="untrained", evaluation=twin)
    campaign = join_campaign([replace(line, masking=0.75), drawn], [moved])
    assert list(campaign.networks) == [key._replace(variant="masked"), key.untrained]
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
