"""The records of policies that the repository ships are intact, make one board, and say how they were made."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
import typer
from click.testing import CliRunner

from brainbench.cli import app
from leaderboards import rank, read_records
from tests.factories.records import VALIDATOR

POLICIES = Path(__file__).parents[2] / "leaderboards" / "policies"


@pytest.fixture(scope="module")
def stored():
    return read_records(POLICIES)


def test_records_are_intact_and_make_one_board_on_which_touch_leads(stored) -> None:
    assert [item.problem for item in stored if item.problem] == []
    for item in stored:
        VALIDATOR.validate(json.loads(item.path.read_text(encoding="utf-8")))
    (board,) = rank(item.record for item in stored if item.record)
    names = [entry.name for entry in board.entries]
    forgets, remembers = (names.index(f"in_palm_rotate_xhand1_none{more}") for more in ("", "_lstm_head-1024-256-128"))
    assert remembers < forgets
    untaught = [names.index(name) for name in names if "frozen" in name] + [remembers]
    assert max(names.index(f"in_palm_rotate_xhand1_force_torque_hand_med_clean_{arm}") for arm in
               ("tactile_convrnn", "reservoir", "rnn")) < min(untaught)  # fmt: skip


def test_every_training_seed_has_a_command_that_exists_and_students_stopped_early_are_unreliable(
    stored,
) -> None:
    tried: set[tuple[str, ...]] = set()
    brainbench = typer.main.get_command(app)
    for item in stored:
        assert item.record is not None
        score = item.record.score
        assert score.status == "unreliable"
        commands = score.provenance["command"].split("; ")
        assert len(commands) == len(score.subjects) == len(score.provenance["settings"]["seeds"]) >= 1
        for command in commands:
            program, *words = shlex.split(command)
            assert program == "brainbench"
            # All words are parsed before help is shown: an unknown option would be refused. Seeds have the same.
            if (options := tuple(word for word in words if word.startswith("--"))) in tried:
                continue
            tried.add(options)
            assert CliRunner().invoke(brainbench, [*words, "--help"]).exit_code == 0
    assert CliRunner().invoke(brainbench, [*words, "--no-such-option", "--help"]).exit_code != 0
