"""Groups of units whose truth is known: the right one is named, and where none is best, none.

``python -m tests.scoring.groups.test_board 200`` prints on how many of so many boards an area is named.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from brainbench.cli.score import score_text
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_plain
from brainbench.core.records import ResultRecord
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.synthetic.populations import PopulationDesign, ResponseGeometry, draw_animals
from brainbench.metrics.measures.rsa import RSA
from brainbench.models.features import write_features
from brainbench.scoring.groups import score_groups
from brainbench.scoring.scores import score_record
from leaderboards.site.build import write_report
from leaderboards.text import group_rows
from tests.factories.recordings import as_recordings, make_simple_session, quiet_design

K = 16
LABELS = tuple(f"s{index:02d}" for index in range(K))


class Quick(RSA):
    splits, orders = 20, 199


def make_board(truth, seed, **design):
    """Score a model against areas that share so much of its geometry (truth: area → share)."""
    random, metric = np.random.default_rng([5, seed]), Quick()
    shared = random.normal(size=(K, 6))
    areas = {}
    for number, (name, share) in enumerate(truth.items()):
        features = math.sqrt(share) * shared + math.sqrt(1 - share) * random.normal(size=(K, 6))
        design = {"animals": 10, "units": 80, "modulation": 0.3, **design}
        animals = draw_animals(features, PopulationDesign(**design), [seed, number])
        flat = {key: [replace(item, responses=item.responses[:, 0]) for item in animals[key]] for key in animals}
        areas[name] = [metric.animal(key, items, K, stimuli=LABELS, seed=0) for key, items in flat.items()]
    layers = {"other": random.normal(size=(K, 50)), "shared": shared @ random.normal(size=(6, 50))}
    return score_groups(metric, layers, areas, by="area", stimuli=LABELS)


def test_the_area_that_shares_the_geometry_is_named_and_ranked_first():
    board = make_board({"S2": 0.0, "S1": 1.0, "M1": 0.0}, 0)
    assert board.best == "S1"
    first, *others = board.groups
    assert (first.group, first.rank, first.layer, first.animals, first.units) == ("S1", "1", "shared", 10, 800)
    assert first.interval is not None
    assert first.interval.low <= first.scaled <= first.interval.high
    assert {group.rank for group in others} == {"2–3"}
    assert "told apart above" in board.reason


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_of_equal_areas_none_is_named(share):
    boards = [make_board(dict.fromkeys(("S1", "S2", "M1"), share), seed, animals=5, units=40) for seed in range(2)]
    assert [board.best for board in boards] == ["", ""]
    assert "is told apart" in boards[0].reason or "is not told apart" in boards[0].reason


def test_areas_of_different_animals_and_too_few_stimuli_are_not_told_apart():
    board = make_board({"S1": 1.0, "S2": 1.0}, 0, animals=3)
    assert (board.best, board.groups[0].rank) == ("", "1–2")
    assert "at least 4 and 10 are needed" in board.reason


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Units of S1 follow a geometry; those of M1 have the same responses to other stimuli."""
    geometry = ResponseGeometry.from_activations(np.random.default_rng(1).normal(size=(12, 5)), LABELS[:12])
    data = as_recordings(geometry, quiet_design(animals=5, units=40))
    counts, labels, subjects = data["counts"].values.copy(), data["stimulus"].values, data["subject"].values
    order = np.random.default_rng(2).permutation(12)
    units = np.flatnonzero(np.arange(counts.shape[2]) % 2)
    for subject in np.unique(subjects):
        rows = [np.flatnonzero((subjects == subject) & (labels == label)) for label in LABELS[:12]]
        counts[np.ix_(np.concatenate(rows), np.arange(1), units)] = data["counts"].values[
            np.ix_(np.concatenate([rows[number] for number in order]), np.arange(1), units)
        ]
    area = np.where(np.arange(counts.shape[2]) % 2, "M1", "S1").astype("U2")
    area[:2] = ""
    data = data.assign(counts=(data["counts"].dims, counts)).assign_coords(area=("unit", area))
    path = tmp_path_factory.mktemp("model") / "model.h5"
    return data, str(write_features(path, LABELS[:12], {"fc": geometry.directions}))


def test_a_record_holds_the_groups_and_text_and_report_show_them(recordings, tmp_path):
    data, model = recordings
    record = score_record(model, recordings=data, by="area", baselines=False, metric=Quick())
    board = record.score.provenance.statistics["groups"]
    assert (board["best"], [group["group"] for group in board["groups"]]) == ("S1", ["S1", "M1"])
    assert [group["units"] for group in board["groups"]] == [99, 99]
    again = ResultRecord.from_json(record.to_json())
    told = "S1 is told apart above 'M1' and above chance; 2 of 200 units state no area and are in none."
    assert told in " ".join(score_text(again).split())
    page = write_report(again, tmp_path / "score.html").read_text()
    assert "Groups of units" in page
    assert "S1 is told apart above" in page
    without = score_record(model, recordings=data, baselines=False, metric=Quick())
    assert without.score.value == record.score.value


def test_no_group_can_be_judged_where_the_recordings_are_in_doubt(recordings):
    data, model = recordings
    data = data.assign_attrs(label_doubt="labels were guessed")
    record = score_record(
        model, recordings=data, by="area", baselines=False, metric=Quick(), match={name: name for name in LABELS[:12]}
    )
    board = record.score.provenance.statistics["groups"]
    assert board["best"] == ""
    assert {(group["status"], group["reasons"][0]) for group in board["groups"]} == {
        ("unreliable", "labels were guessed")
    }


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ("aera", "Unknown group of units 'aera'; did you mean 'area'"),
        ("area=S1|M2", "Unknown area 'M2'; did you mean 'M1'"),
        ("layer", "No unit of these recordings has a value of 'layer'; they have 'area'"),
        ("area=S1|S1", "'S1' more than once"),
    ],
)
def test_groups_that_are_not_there_are_answered_in_one_sentence(recordings, by, words):
    data, model = recordings
    with pytest.raises((UsageError, DataError), match=words.replace("|", r"\|")):
        score_record(model, recordings=data, by=by, baselines=False)


def test_files_name_areas_and_cell_types_in_several_ways(tmp_path):
    columns = {"location": ["S1", "S1", "M1"], "cell_class": ["FS", "RS", "RS"], "cortical_layer": ["4", "4", "5"]}
    path = write_recordings(tmp_path / "a.h5", make_simple_session(unit_columns=columns))
    data = open_recordings(path, conditions="trials:stimulus")
    stated = {name: data[name].values.tolist() for name in ("area", "cell_type", "layer")}
    assert stated == dict(zip(("area", "cell_type", "layer"), columns.values(), strict=True))


@pytest.mark.parametrize("statistics", [{}, {"groups": 3}, {"groups": {"groups": [{"group": "<b>"}]}}])
def test_a_page_passes_over_what_is_no_board_of_groups(statistics):
    assert group_rows(statistics) is None


def test_a_board_is_plain_data():
    assert to_plain(make_board({"S1": 1.0}, 0, animals=4, units=20))["by"] == "area"


def print_boards(number):
    """Print which area is named, of three whose truth is known: one has the model's geometry, or all have it."""
    for truth in ({"S2": 0.0, "S1": 1.0, "M1": 0.0}, {"S2": 1.0, "S1": 1.0, "M1": 1.0}):
        named = Counter(make_board(truth, seed).best or "none" for seed in range(number))
        areas = ", ".join(f"{area} {share:g}" for area, share in truth.items())
        sys.stdout.write(f"{areas}: named {dict(named)}\n")


if __name__ == "__main__":
    print_boards(int(sys.argv[1]))
