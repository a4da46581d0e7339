"""Stale and conflicting records are found, and nothing else is."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from brainbench.core import records
from brainbench.core.errors import DataFileNotFoundError
from brainbench.core.files import to_plain
from brainbench.core.identity import SealedPlan
from leaderboards import build_leaderboard
from leaderboards.audit import MOST_NAMED, compare_builds, conflicting, differences, open_build, remarks
from leaderboards.boards import rank
from leaderboards.store import StoredRecord, read_records, write_record
from tests.factories.records import draw_board


def _stored(record, path):
    return StoredRecord(path / "x.json", record)


def _with(record, **provenance):
    return replace(record, score=replace(record.score, provenance={**record.score.provenance, **provenance}))


def test_a_current_record_is_left_alone(make_record, tmp_path):
    assert remarks([_stored(make_record(), tmp_path)]) == {}


def test_an_older_estimator_is_stale_and_an_older_package_alone_is_not(make_record, tmp_path):
    assert remarks([_stored(_with(make_record(), version="0.0.9"), tmp_path)]) == {}
    record = _with(make_record(), settings={"estimator_version": 0})
    ((doubt,),) = remarks([_stored(record, tmp_path)]).values()
    assert doubt.startswith("stale: version 0 of the default estimator, now 5")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"value": 0.987, "interval": records.Interval(0.1, 0.36)}, "interval of the score 'zhuang' runs from 0.1 to"),
        ({"value": 0.05, "interval": records.Interval(0.1, 0.36)}, "without the number 0.05"),
        ({"reliability_interval": records.Interval(0.1, 0.3)}, "reliability_interval of the score"),
        (
            {"layers": (records.LayerScore("fc", 0.9, 0.4, interval=records.Interval(0.1, 0.3)),)},
            "the interval of layer 'fc' of the score",
        ),
    ],
)
def test_an_interval_that_misses_its_number_is_doubtful(make_record, tmp_path, change, words):
    ((doubt,),) = remarks([_stored(make_record(**change), tmp_path)]).values()
    assert doubt.startswith("doubtful: ")
    assert words in doubt


def test_what_deviates_from_a_sealed_plan_is_marked_whatever_the_record_says_of_it(make_record, tmp_path):
    record = make_record()
    plan = SealedPlan("power", len(record.score.stimuli) or 2, 99)
    ((remark,),) = remarks([_stored(_with(record, plan=to_plain(plan)), tmp_path)]).values()
    assert remark.startswith(f"plan: deviates from the sealed plan {plan.hash}: ")
    assert "planned 99" in remark
    ((remark,),) = remarks([_stored(_with(record, plan={"made_by": "power"}), tmp_path)]).values()
    assert remark.startswith("plan: its plan cannot be read")


def test_stimuli_of_an_earlier_definition_of_a_fidelity_are_stale(make_record, tmp_path):
    settings = {"fidelity": "balanced", "whiskers": "all"}
    described = {"description": "rodgers, mouse"}
    old = _with(make_record("a"), settings=settings, time="2026-01", stimuli={**described, "content_hash": "1"})
    new = _with(make_record("b"), settings=settings, time="2026-02", stimuli={**described, "content_hash": "2"})
    coarse = _with(
        make_record("c"),
        settings={**settings, "fidelity": "fast"},
        time="2026-03",
        stimuli={**described, "content_hash": "3"},
    )
    found = remarks([_stored(record, tmp_path) for record in (old, new, coarse)])
    assert list(found) == [old.identity]
    assert "another engine or an earlier definition of fidelity 'balanced'" in found[old.identity][0]


def test_another_pairing_of_labels_is_another_computation_and_another_board(make_record, tmp_path):
    straight = {"convex": "convex", "concave": "concave"}
    one = _with(make_record("a", 0.5), pairs=straight)
    other = _with(make_record("a", 0.6), pairs={"convex": "concave", "concave": "convex"})
    assert remarks([_stored(record, tmp_path) for record in (one, other)]) == {}
    assert [len(board.entries) for board in rank([one, other])] == [1, 1]
    # A record of an earlier version, without pairs, paired equal labels.
    assert list(conflicting(_with(make_record("a", 0.6)), [one])) == [one]


def test_the_same_computation_with_other_numbers_is_a_conflict_on_both_sides(make_record, tmp_path):
    one, other, unrelated = make_record("a", 0.5), make_record("a", 0.6), make_record("b", 0.7)
    found = remarks([_stored(record, tmp_path) for record in (one, other, unrelated)])
    assert set(found) == {one.identity, other.identity}
    assert f"0.5000 here and 0.6000 in the record {other.identity}" in found[one.identity][0]
    assert list(conflicting(one, [one, other, unrelated])) == [other]


def test_many_contradicting_records_name_a_few_of_one_another(make_record, tmp_path):
    found = remarks([_stored(make_record("a", 0.01 * k), tmp_path) for k in range(30)])
    assert {len(sentences) for sentences in found.values()} == {MOST_NAMED}


def test_last_digits_and_other_options_are_no_conflict(make_record, tmp_path):
    one, near = make_record("a", 0.5), make_record("a", 0.5 + 1e-6)
    others = [
        _with(make_record("a", 0.6), settings={"time": "mean", "seed": 0} | change)
        for change in ({"seed": 1}, {"layer": "conv3"}, {"units_reliability": 0.5})
    ]
    assert remarks([_stored(record, tmp_path) for record in (one, near, *others)]) == {}


def test_a_record_is_hashed_once_however_many_rivals_ask_for_its_identity(make_record, monkeypatch):
    hashed = []
    monkeypatch.setattr(records, "record_identity", lambda data: hashed.append(data) or str(len(hashed)))
    one, other = make_record(value=0.5), make_record(value=0.7)
    assert list(conflicting(one, [other] * 20)) == [other] * 20
    assert len(hashed) == 2


def _build(records, folder):
    for record in records:
        write_record(record, folder)
    return read_records(folder)


def test_a_record_does_not_differ_from_itself(make_record):
    record = make_record(p=math.nan)
    assert differences(record, record, tolerance=0.0) == []


def test_each_difference_is_named_by_its_place(make_record):
    record = make_record()
    layers = (replace(record.score.layers[0], value=0.6), *record.score.layers[1:])
    score = replace(record.score, value=0.6, status="unreliable", layers=layers)
    card = replace(record.card, weights="abc")
    found = {
        item.what: (item.before, item.after) for item in differences(record, replace(record, score=score, card=card))
    }
    assert found == {
        "card.weights": (None, "abc"),
        "score.value": (0.523, 0.6),
        "score.status": ("ok", "unreliable"),
        "score.layers[0](conv3).value": (0.529, 0.6),
    }


def test_records_in_two_places_are_read_once(make_record, tmp_path):
    for folder in ("one", "other"):
        write_record(make_record(), tmp_path / folder / "records")
    write_record(make_record("another"), tmp_path / "other" / "records")
    found = open_build(tmp_path / "one", tmp_path / "other")
    assert sorted(item.record.score.name for item in found) == ["another", "zhuang"]


def test_numbers_within_the_tolerance_are_equal(make_record):
    record = make_record()
    near = replace(record, score=replace(record.score, value=0.5235))
    assert differences(record, near) == []
    assert [item.what for item in differences(record, near, tolerance=1e-4)] == ["score.value"]


@pytest.mark.parametrize("unit", [1.0, 1e6, 1e-6])
def test_distances_count_in_shares_of_the_largest_whatever_their_unit(make_record, unit):
    record = make_record(brain_rdm=(2.0 * unit, 8.0 * unit, 0.1 * unit))
    for change, places in ((0.004, []), (0.02, ["score.brain_rdm[2]"])):
        again = replace(record.score, brain_rdm=(2.0 * unit, 8.0 * unit, (0.1 + change) * unit))
        assert [item.what for item in differences(record, replace(record, score=again))] == places


def test_weights_drawn_from_a_seed_may_differ_in_the_last_digits_and_trained_ones_may_not(make_record):
    record = make_record()
    for objective, places in (("untrained", []), ("simclr", ["card.weights"])):
        cards = [replace(record.card, objective=objective, weights=weights) for weights in ("abc", "def")]
        left, right = (replace(record, card=card) for card in cards)
        assert [item.what for item in differences(left, right)] == places


CLAIMS = {
    "synthetic": False,
    "card.seed": 9,
    "card.top1": 0.99,
    "card.family": "transformer",
    "card.graph.nodes.0.kind": "attention",
    "score.name": "our-network",
    "score.provenance.statistics.unique.unique": 0.99,
    "score.provenance.statistics.unique.status": "ok",
    "score.provenance.statistics.effective.units": 30.0,
    "score.provenance.recordings.ledger.trials.found": 99,
    "score.provenance.benchmark.name": "the benchmark",
}
"""Places of a record that pages show beside its scores, each with something else to state there."""


@pytest.mark.parametrize("place", CLAIMS)
def test_nothing_else_that_pages_show_is_confirmed(make_record, place):
    statistics = {"unique": {"unique": 0.02, "status": "unreliable"}, "effective": {"units": 27.1}}
    brain = {"source": "demo", "ledger": {"trials": {"found": 90, "read": 80}}}
    record = _with(make_record(), statistics=statistics, recordings=brain, benchmark={"name": "lab"})
    graph = records.ModelGraph((records.GraphNode("conv1", "encoder", "convolution"),), ())
    record = replace(record, card=replace(record.card, graph=graph))
    edited = to_plain(record)
    *path, last = place.split(".")
    inner = edited
    for name in path:
        inner = inner[int(name) if name.isdecimal() else name]
    inner[last] = CLAIMS[place]
    (difference,) = differences(records.ResultRecord.from_json(edited), record)
    assert difference.before == CLAIMS[place]
    assert difference.what.endswith(last)


def test_what_a_record_does_not_state_is_no_claim_and_what_is_not_found_again_is(make_record):
    """A record of an earlier version says less, but nothing that this version does not find."""
    more = _with(make_record(), statistics={"unique": {"unique": 0.02}})
    assert differences(make_record(), more) == []
    assert [item.what for item in differences(more, make_record())] == ["statistics.unique.unique"]


def _named(truths, **design):
    return {record.score.name: record for record in draw_board(truths, spread=0.1, **design)}


def test_builds_show_what_came_went_changed_and_moved(tmp_path):
    drawn = _named({"stays": 0.2, "changes": 0.9, "goes": 0.55, "comes": 0.6})
    changed = _named({"stays": 0.2, "changes": 0.4}, seed=1)["changes"]
    settings = {**changed.score.provenance.settings, "estimator_version": records.ESTIMATOR_VERSION}
    provenance = {**changed.score.provenance, "settings": settings}
    changed = replace(changed, score=replace(changed.score, provenance=provenance))
    old = _build([drawn["stays"], drawn["goes"], drawn["changes"]], tmp_path / "old")
    new = _build([drawn["stays"], changed, drawn["comes"], drawn["goes"]], tmp_path / "new")
    without = _build([drawn["stays"], changed, drawn["comes"]], tmp_path / "without")
    found = {change.name: change for change in compare_builds(old, without)}
    assert {name: change.kind for name, change in found.items()} == {
        "comes (seed 0)": "added",
        "goes (seed 0)": "removed",
        "changes (seed 0)": "changed",
    }
    assert found["changes (seed 0)"].causes[0] == f"estimator version: none → {records.ESTIMATOR_VERSION}"
    assert found["changes (seed 0)"].before.endswith("rank 1")
    assert found["changes (seed 0)"].after.endswith("rank 2")
    moved = {change.name: change for change in compare_builds(old, new) if change.kind == "moved"}
    assert moved["stays (seed 0)"].before.endswith("rank 3")
    assert moved["stays (seed 0)"].after.endswith("rank 4")
    assert compare_builds(new, new) == []


def test_scores_of_a_name_on_several_stimuli_are_compared_each_with_its_own(tmp_path):
    """The board of other stimuli came first after three models were added, and changed places with the first."""

    def on(stimuli, names, more=0.0):
        # Of one name on both boards everything is equal but the stimuli and the values.
        drawn = draw_board(names, seed=len(stimuli))
        moved = [replace(record, score=replace(record.score, value=record.score.value + more)) for record in drawn]
        return [_with(record, stimuli={"description": stimuli, "content_hash": stimuli}) for record in moved]

    old = [*on("near", {"m": 0.3, "k": 0.2}), *on("farther", {"m": 0.8})]
    new = [*on("near", {"m": 0.3, "k": 0.2}, 0.01), *on("farther", {"m": 0.8, "a": 0.1, "b": 0.1, "c": 0.2}, 0.01)]
    builds = ([StoredRecord(tmp_path / str(place), record) for place, record in enumerate(one)] for one in (old, new))
    changed = [change for change in compare_builds(*builds) if change.kind == "changed" and change.name.startswith("m")]
    assert [change.causes for change in changed] == [(), ()]


def test_a_record_of_an_earlier_estimator_changes_when_it_is_scored_again(tmp_path):
    record = _named({"net": 0.5})["net"]
    stated = record.score.provenance.settings
    old, new = (_with(record, settings={**stated, "estimator_version": version}) for version in (3, 4))
    new = replace(new, score=replace(new.score, value=new.score.value + 0.01))
    (change,) = compare_builds(_build([old], tmp_path / "old"), _build([new], tmp_path / "new"))
    assert (change.kind, change.causes) == ("changed", ("estimator version: 3 → 4",))


def test_the_newest_stimuli_are_those_of_the_latest_moment_in_any_zone(make_record, tmp_path):
    settings = {"fidelity": "balanced"}
    described = {"description": "rodgers, mouse"}
    early, late = (
        _with(make_record(name), settings=settings, stimuli={**described, "content_hash": name}, time=time)
        for name, time in (("early", "2026-11-30T12:00:00+02:00"), ("late", "2026-11-30T11:00:00+00:00"))
    )
    assert list(remarks([_stored(early, tmp_path), _stored(late, tmp_path)])) == [early.identity]


def test_a_standing_that_changes_alone_is_told(make_record, tmp_path):
    record = make_record("net")
    chance = replace(record, score=replace(record.score, p=0.4))
    (change,) = compare_builds(_build([record], tmp_path / "old"), _build([chance], tmp_path / "new"))
    assert change.before.partition(",")[0] == change.after.partition(",")[0]
    assert "not told apart from chance" in change.after
    assert "not told apart from chance" not in change.before


def test_a_site_is_read_by_the_records_it_holds(make_record, tmp_path):
    site = build_leaderboard([make_record()], tmp_path / "site").parent
    (stored,) = open_build(site)
    assert stored.record == make_record()
    with pytest.raises(DataFileNotFoundError):
        open_build(tmp_path / "nowhere")


def test_another_record_with_the_same_numbers_is_restated(make_record, tmp_path):
    record = make_record("net")
    more = replace(record, score=replace(record.score, provenance={**record.score.provenance, "note": "said later"}))
    (change,) = compare_builds(_build([record], tmp_path / "old"), _build([more], tmp_path / "new"))
    assert (change.kind, change.causes) == ("restated", ())
