"""The leaderboard that the repository ships is intact, large enough, and can be made again."""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.simulation import config_hash
from leaderboards import rank, read_records
from leaderboards.audit import remarks
from tests.factories.records import VALIDATOR

RESULTS = Path(__file__).parents[2] / "leaderboards" / "results"


@pytest.fixture(scope="module")
def stored():
    return read_records(RESULTS)


def test_every_shipped_record_is_intact_and_none_contradicts_another(stored):
    assert [item.problem for item in stored if item.problem] == []
    assert [text for doubts in remarks(stored).values() for text in doubts if text.startswith("conflict")] == []


def test_a_score_made_on_this_processor_stands_on_the_shipped_board(stored):
    made = config_hash(get_recipe("objects").scenes, Fidelity.parse("balanced,twist=false"), DEFAULT_ENGINE)
    hashes = {item.record.score.provenance.stimuli_hash for item in stored if item.record}
    assert hashes == {made}


def test_shipped_records_fit_the_published_schema(stored):
    for item in stored[:5]:
        VALIDATOR.validate(json.loads(item.path.read_text(encoding="utf-8")))


def test_there_are_at_least_24_entries_with_twins_over_5_seeds_and_their_spread(stored):
    (board,) = rank(item.record for item in stored if item.record)
    entries = board.entries
    assert len(entries) >= 24
    assert board.synthetic
    seeds = Counter(entry.seeds for entry in entries if not entry.trained)
    assert seeds[5] >= 12
    assert all(len({record.score.value for record in entry.records}) == 5 for entry in entries if entry.seeds == 5)
    controls = {"animal-to-animal", "raw input", "random features", "presentation time"}
    assert {item.name for item in board.baselines} == controls
    assert [item.notes for item in board.baselines] == [()] * 4  # one brain side and one seed of the statistics
    full = [entry for entry in entries if "-small" not in entry.name]
    assert len(full) >= 12


def test_every_shipped_record_says_how_to_make_it_and_draws_its_architecture(stored):
    for item in stored:
        assert item.record is not None
        command = item.record.score.provenance["command"]
        assert command.startswith(f"brainbench score {item.record.score.name}")
        assert item.record.card is not None
        assert item.record.card.graph is not None
        assert item.record.card.encoder


def test_the_batch_file_names_what_is_shipped(stored):
    batch = tomllib.loads((RESULTS / "batch.toml").read_text(encoding="utf-8"))
    wanted = {name for entry in batch["entries"] for name in entry["models"] if "*" not in name}
    assert wanted == {item.record.score.name for item in stored if item.record and "." not in item.record.score.name}


@pytest.mark.slow
def test_a_shipped_record_is_confirmed_by_scoring_it_again(stored):
    from brainbench.cli.leaderboard.verify import Repetition, score_again
    from leaderboards.audit import differences

    record = next(item.record for item in stored if item.record and item.record.score.name == "s4-small")
    # The demo recordings are made anew on this machine; their last digits may differ, their statistics may not.
    assert differences(record, score_again(record, Repetition())) == []


def test_the_table_of_trained_networks_states_the_scores_of_their_records(stored):
    scores = {
        (item.record.score.name, item.record.card.seed): item.record.score for item in stored if item.record is not None
    }
    page = RESULTS.parents[1] / "docs" / "networks.md"
    rows = [line.strip("| \n").split(" | ") for line in page.read_text(encoding="utf-8").splitlines()]
    rows = [row for row in rows if len(row) == 6 and row[1].lower() in ("supervised", "simclr")]
    assert len(rows) == 8
    for name, objective, *_, trained, twin in rows:
        name = name.strip("`")
        for key, text in (((f"{name}.{objective.lower()}", 0), trained), ((name, 0), twin)):
            interval = scores[key].scaled_interval
            assert interval is not None
            assert text == f"{scores[key].scaled:.2f} [{interval.low:.2f}, {interval.high:.2f}]", key
