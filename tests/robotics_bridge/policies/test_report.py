"""Comparing students."""

from __future__ import annotations

import itertools
from dataclasses import asdict

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import DataError
from brainbench.core.files import content_hash, read_json, write_json
from brainbench.core.statistics import newcombe_interval
from leaderboards import rank, write_record
from leaderboards.store import read_record
from robotics_bridge.policies.report.figure import draw
from robotics_bridge.policies.report.records import command, records
from robotics_bridge.policies.report.results import LeftOut, read_agents, read_results
from robotics_bridge.policies.report.tables import COLUMNS, agent_rows, concise, remarks, rows
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.task import TASK_VERSION


def _write(folder, shares, *, seed=0, **changes) -> None:
    config = DistillConfig(task="in_palm_rotate", seed=seed, **changes)
    write_json(folder / config.name / "config.json", {"distill": asdict(config), "task_version": TASK_VERSION})
    found = [
        {"seed": index, "success": [float(i < round(20 * share)) for i in range(20)], "metric": [share] * 20}
        for index, share in enumerate(shares)
    ]
    write_json(folder / config.name / "evaluation.json", found)


def _learn(folder, iterations) -> None:
    for path in folder.rglob("evaluation.json"):
        write_json(path, [{**item, "iterations": iterations} for item in read_json(path)])


def _three_seeds(folder) -> None:
    for seed, (felt, bare) in enumerate([(0.8, 0.5), (0.9, 0.55), (0.7, 0.45)]):
        _write(folder, [felt] * 3, seed=seed, observe="force_torque")
        _write(folder, [bare] * 3, seed=seed, observe="none")


def test_success_and_gain_have_t_intervals_over_training_seeds(tmp_path) -> None:
    _three_seeds(tmp_path)
    felt, bare = read_results([tmp_path])
    assert (felt.config.observe, bare.config.observe) == ("force_torque", "none")
    reference = stats.ttest_1samp([0.8, 0.9, 0.7], 0).confidence_interval()
    assert felt.value == pytest.approx(0.8)
    assert felt.interval is not None
    # Of three seeds the interval of the mean passes 1, which no share does.
    assert reference.high > 1
    assert (felt.interval.low, felt.interval.high) == pytest.approx((reference.low, 1.0))
    paired = stats.ttest_rel([0.8, 0.9, 0.7], [0.5, 0.55, 0.45]).confidence_interval()
    assert felt.difference is not None
    assert (felt.difference.low, felt.difference.high) == pytest.approx(tuple(paired))
    assert felt.episodes == 180
    assert not felt.note
    table = rows([felt, bare])
    assert len(table[0]) == len(COLUMNS)
    assert table[0][COLUMNS.index("over none")].startswith("+0.300")


def test_students_with_and_without_memory_are_two_arms(tmp_path) -> None:
    _three_seeds(tmp_path)
    for seed in range(3):
        _write(tmp_path, [0.6] * 3, seed=seed, observe="none", embedder="lstm")
    felt, remembered, bare = read_results([tmp_path])
    assert (remembered.config.embedder, bare.config.embedder) == ("lstm", "mlp")
    # What touch adds is counted from the better of them.
    assert felt.gain == pytest.approx(0.2)
    assert [row[COLUMNS.index("touch")] for row in rows([felt, remembered])] == ["force_torque", "none (lstm)"]


def test_students_of_other_sizes_are_other_arms(tmp_path) -> None:
    _write(tmp_path, [0.9] * 3, observe="force_torque", encoder="rnn")
    _write(tmp_path, [0.6] * 3, observe="force_torque", encoder="rnn", encoder_settings={"units": 9})
    _write(tmp_path, [0.3] * 3, observe="force_torque", encoder="rnn", hidden=(1024, 256, 128))
    table = rows(read_results([tmp_path]))
    assert [row[COLUMNS.index("encoder")] for row in table] == ["rnn", "rnn (9 units)", "rnn"]
    assert table[2][COLUMNS.index("touch")] == "force_torque (head-1024-256-128)"


def test_students_that_learned_otherwise_are_no_seeds_of_one_arm(tmp_path) -> None:
    _write(tmp_path / "one", [0.9] * 3, observe="none", learning_rate=5e-4)
    _write(tmp_path / "other", [0.6] * 3, observe="none", learning_rate=1e-4, seed=1)
    with pytest.raises(DataError, match=r"differ in 'learning_rate' \(0.0005, 0.0001\)"):
        read_results([tmp_path])
    assert len(read_results([tmp_path / "one"])) == 1


def test_a_single_student_is_said_to_be_one(tmp_path) -> None:
    _write(tmp_path, [0.5, 0.6, 0.7], observe="bool", placement="tips")
    (only,) = read_results([tmp_path])
    assert only.value == pytest.approx(0.6)
    assert "chance in evaluation alone" in only.note
    assert only.interval is not None
    expected = stats.binomtest(36, 60).proportion_ci(method="wilson")
    assert (only.interval.low, only.interval.high) == pytest.approx((expected.low, expected.high), abs=1e-6)
    assert records([only])[0].score.status == "unreliable"


def test_the_gain_of_a_single_student_has_an_interval_over_episodes(tmp_path) -> None:
    published = newcombe_interval(56, 70, 48, 80)  # Newcombe 1998, table II, contrast (a), method 10
    assert (published.low, published.high) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    _write(tmp_path, [0.8] * 3, observe="force_torque")
    _write(tmp_path, [0.5] * 3, observe="none")
    felt, bare = read_results([tmp_path])
    assert felt.gain == pytest.approx(0.3)
    expected = newcombe_interval(48, 60, 30, 60)
    assert felt.difference is not None
    assert (felt.difference.low, felt.difference.high) == pytest.approx((expected.low, expected.high))
    assert bare.gain is None


def test_students_of_other_contacts_are_not_compared(tmp_path) -> None:
    for contacts, share in (("firm", 0.5), ("published", 0.2)):
        _write(tmp_path, [share] * 3, observe="none", contacts=contacts)
        _write(tmp_path, [0.8] * 3, observe="force_torque", contacts=contacts)
    results = read_results([tmp_path])
    assert [result.world[2] for result in results] == ["firm", "firm", "published", "published"]
    assert [result.gain for result in results] == pytest.approx([0.3, None, 0.6, None])
    firm, _, published, _ = records(results)
    protocol = {"task": "in_palm_rotate", "hand": "xhand1", "variant": "default", "task_version": str(TASK_VERSION)}
    hashes = [record.score.provenance.recordings["content_hash"] for record in (firm, published)]
    assert hashes == [content_hash({**protocol, "contacts": "firm"}), content_hash(protocol)]


def test_what_all_students_share_is_said_once(tmp_path) -> None:
    _write(tmp_path, [0.8] * 3, observe="force_torque")
    _write(tmp_path, [0.5] * 3, observe="none")
    title, columns, found = concise(rows(read_results([tmp_path])))
    assert title.startswith("task: in_palm_rotate, hand: xhand1, placement: hand, resolution: med, noise: clean")
    assert columns[:2] == ["touch", "success"]
    assert [row[0] for row in found] == ["force_torque", "none"]
    assert remarks(read_results([tmp_path])) == ["one training seed: the interval covers chance in evaluation alone"]


def test_two_runs_of_one_training_seed_are_no_two_seeds(tmp_path) -> None:
    for run, share, learned in (("first", 0.4, 77), ("again", 0.6, 110)):
        _write(tmp_path / run, [share] * 3, observe="none", iterations=110)
        _learn(tmp_path / run, learned)
    (only,) = read_results([tmp_path])
    assert (only.seeds, only.success, only.learned) == ((0,), (pytest.approx(0.6),), (110,))
    assert only.left_out == (LeftOut(0, 77, "trained once more, for 110"),)
    said = "left out: in_palm_rotate_xhand1_none, seed 0, after 77 iterations (trained once more, for 110)"
    assert said in remarks([only])
    assert only.note == "one training seed: the interval covers chance in evaluation alone"


def test_students_that_learned_too_little_are_left_out_by_name(tmp_path) -> None:
    for seed, learned in enumerate((110, 98, 18)):
        _write(tmp_path / str(seed), [0.5 + seed / 10] * 3, seed=seed, observe="none", iterations=110)
        _learn(tmp_path / str(seed), learned)
    (every,) = read_results([tmp_path])
    assert (every.seeds, every.iterations) == ((0, 1, 2), 18)
    assert "stopped after 18 to 110 of 110 iterations" in every.note
    (kept,) = read_results([tmp_path], at_least=98)
    assert (kept.seeds, kept.learned) == ((0, 1), (110, 98))
    assert kept.left_out == (LeftOut(2, 18, "fewer than 98"),)
    assert "only 2 training seeds" in kept.note
    assert rows([kept])[0][COLUMNS.index("iterations")] == "98 to 110"
    with pytest.raises(DataError, match=r"500 iterations.* 110"):
        read_results([tmp_path], at_least=500)


def test_what_happened_beside_success_has_t_intervals_over_training_seeds(tmp_path) -> None:
    means = [0.8, 1.1, 0.9]
    for seed, mean in enumerate(means):
        _write(tmp_path, [0.5] * 3, seed=seed, observe="none")
        path = next(path for path in tmp_path.iterdir() if path.name.endswith(f"seed{seed}")) / "evaluation.json"
        write_json(path, [{**item, "goals": [mean - 0.5, mean + 0.5] * 10} for item in read_json(path)])
    (only,) = read_results([tmp_path])
    mean, half = only.graded["goals"]
    low, high = stats.ttest_1samp(means, 0).confidence_interval()
    assert (mean - half, mean + half) == pytest.approx((low, high))


def test_a_record_of_several_seeds_says_how_to_make_each(tmp_path) -> None:
    _three_seeds(tmp_path)
    score = records(read_results([tmp_path]))[0].score
    assert [subject.subject for subject in score.subjects] == ["seed 0", "seed 1", "seed 2"]
    assert score.status == "ok"
    assert score.provenance["settings"]["seeds"] == [0, 1, 2]
    assert score.provenance["command"].split("; ") == [
        "brainbench policy distill in_palm_rotate",
        "brainbench policy distill in_palm_rotate --seed 1",
        "brainbench policy distill in_palm_rotate --seed 2",
    ]


def test_how_far_students_were_trained_is_said_once(tmp_path) -> None:
    for observe, learned in (("force_torque", 77), ("none", 110)):
        _write(tmp_path, [0.5] * 3, observe=observe, iterations=6000)
        folder = next(path for path in tmp_path.iterdir() if observe in path.name)
        found = read_json(folder / "evaluation.json")
        write_json(folder / "evaluation.json", [{**item, "iterations": learned} for item in found])
    assert remarks(read_results([tmp_path]))[1:] == ["stopped after 77 to 110 of 6000 iterations"]


def test_what_happened_beside_success_stands_in_the_table_and_in_records(tmp_path) -> None:
    config = DistillConfig(task="in_palm_rotate", observe="none", iterations=100)
    rng = np.random.default_rng(0)
    rates = [rng.normal(0.4, 0.1, 50).tolist() for _ in range(3)]
    found = [
        {"seed": seed, "success": [0.0] * 50, "turn_rate": rate, "goals": [0.0] * 50, "iterations": 40}
        for seed, rate in enumerate(rates)
    ]
    write_json(tmp_path / config.name / "config.json", {"distill": asdict(config), "task_version": TASK_VERSION})
    write_json(tmp_path / config.name / "evaluation.json", found)
    agent = {"agent": "runs/teacher", "task": "in_palm_rotate", "success_rate": 0.1, "success_interval": [0.05, 0.2]}
    write_json(tmp_path / "agents.json", [agent | {"turn_rate": 0.5, "turn_rate_half_width": 0.01}])
    (only,) = read_results([tmp_path])
    reference = stats.norm.interval(0.95, np.mean(rates), stats.sem(np.ravel(rates)))
    mean, half = only.graded["turn_rate"]
    assert (mean - half, mean + half) == pytest.approx(tuple(reference), rel=1e-6)
    assert "stopped after 40 of 100 iterations" in only.note
    score = records([only])[0].score
    assert score.status == "unreliable"
    assert score.provenance["settings"]["mean_turn_rate"] == pytest.approx(mean)
    line = dict(zip(COLUMNS, rows([only])[0], strict=True))
    assert (line["iterations"], line["goals"], line["s"]) == ("40", "0 ± 0", "–")
    agents = read_agents([tmp_path])
    line = dict(zip(COLUMNS, agent_rows(agents)[0], strict=True))
    assert (line["touch"], line["success"], line["rad/s"]) == ("teacher", "0.100 [0.050, 0.200]", "0.5 ± 0.01")
    assert draw([only], tmp_path / "a.png", agents=agents).stat().st_size > 1000
    (tmp_path / "agents.json").write_text('[{"agent": "x"}]')
    with pytest.raises(DataError, match=r"/agents\.json' .*policy evaluate"):
        read_agents([tmp_path])


def test_records_make_a_board_of_the_leaderboard(tmp_path) -> None:
    _three_seeds(tmp_path / "runs")
    found = records(read_results([tmp_path / "runs"]))
    stored = [read_record(write_record(record, tmp_path / "records")) for record in found]
    (board,) = rank(stored)
    assert board.recordings == f"in_palm_rotate on xhand1 (default), version {TASK_VERSION} of the tasks"
    assert "force_torque" in board.entries[0].name
    assert "stimuli" in board.entries[0].unranked_because


def test_a_record_says_how_to_make_its_student(tmp_path) -> None:
    assert command(DistillConfig(task="in_palm_rotate")) == "brainbench policy distill in_palm_rotate"
    config = DistillConfig(
        task="in_palm_rotate", variant="careful", teacher="in_palm_rotate.teacher", placement="tips", noisy=True,
        encoder="zhuang-small.simclr", encoder_settings={"learning": "frozen"}, num_envs=64, iterations=6000,
        learning_rate=5e-4,
    )  # fmt: skip
    assert command(config, stop_at=77) == (
        "brainbench policy distill in_palm_rotate --teacher in_palm_rotate.teacher --config careful --placement tips "
        "--encoder zhuang-small.simclr --noisy --learning frozen --envs 64 --iterations 6000 --learning-rate 0.0005 "
        "--stop-at 77"
    )
    small = DistillConfig(task="in_palm_rotate", encoder="rnn", encoder_settings={"units": 9}, hidden=(128, 64))
    assert command(small) == "brainbench policy distill in_palm_rotate --encoder rnn --units 9 --hidden 128,64"


def test_the_picture_shows_every_group(tmp_path) -> None:
    _three_seeds(tmp_path)
    from PIL import Image

    path = draw(read_results([tmp_path]), tmp_path / "report.png")
    assert np.ptp(np.asarray(Image.open(path).convert("L"))) > 100


def test_missing_and_damaged_evaluations_are_named(tmp_path) -> None:
    with pytest.raises(DataError, match="brainbench policy distill"):
        read_results([tmp_path])
    _write(tmp_path, [0.5])
    path = next(tmp_path.rglob("evaluation.json"))
    path.write_text('[{"seed": 0}]')
    with pytest.raises(DataError, match=r"evaluation\.json' .*success"):
        read_results([tmp_path])


def test_draws_of_an_encoder_are_crossed_with_training_seeds(tmp_path) -> None:
    rng = np.random.default_rng(0)
    for number, seed in itertools.product(range(3), range(3)):
        share = round(20 * (0.5 + 0.1 * (number - 1) + rng.normal(0, 0.01))) / 20
        settings = {"encoder": "reservoir", "encoder_settings": {"seed": number}}
        _write(tmp_path / str(number), [share] * 3, seed=seed, **settings)
    for seed in range(3):
        _write(tmp_path, [0.4], seed=seed, observe="none")
    drawn, bare = read_results([tmp_path])
    # One student for each cell, none of them "trained once more", and three training seeds for the gain over no touch.
    assert (len(drawn.success), drawn.left_out) == (9, ())
    assert len({config.name for config in drawn.configs}) == 9
    assert drawn.gain == pytest.approx(drawn.value - bare.value)
    # Nine students of three networks tell as much as three networks do.
    assert drawn.interval is not None
    assert "draw" in drawn.interval.method
    assert drawn.interval.high - drawn.interval.low > 0.25
    (subjects, _) = (record.score.subjects for record in records([drawn, bare]))
    assert [one.subject for one in subjects][:2] == ["seed 0, seed 0", "seed 0, seed 1"]


def test_students_of_one_training_of_a_network_are_no_repeats_of_trainings(tmp_path) -> None:
    # Three trainings that differ by .1, two students of each that differ by .01, each of another seed.
    for seed, (number, share) in enumerate(itertools.product(range(3), (0.0, 0.01))):
        settings = {"encoder": "zhuang-small.simclr", "encoder_settings": {"pretrained": f"runs/{number}/best"}}
        _write(tmp_path / str(number), [0.5 + 0.1 * number + share] * 3, seed=seed, **settings)
    (drawn,) = read_results([tmp_path])
    # t of three trainings has 4.3 × .1 / √3 = .25 on either side; of six independent students it would have .09.
    assert drawn.interval is not None
    assert (drawn.interval.high - drawn.interval.low) / 2 == pytest.approx(4.303 * 0.1 / 3**0.5, rel=0.02)
    (record,) = records([drawn])
    assert [one.subject for one in record.score.subjects][:2] == ["seed 0, runs/0/best", "seed 1, runs/0/best"]


@pytest.mark.parametrize(
    ("settings", "draw"),
    [
        ({"encoder": "mlp"}, None),
        ({"observe": "none"}, None),
        ({"encoder": "reservoir"}, "seed 2"),
        ({"encoder": "zhuang-small", "encoder_settings": {"seed": 7}}, "seed 7"),
        ({"encoder": "zhuang-small.simclr"}, "zhuang-small.simclr"),
        ({"encoder": "zhuang-small.simclr", "encoder_settings": {"pretrained": "runs/b/model.safetensors"}}, "runs/b/"),
    ],
)
def test_what_was_drawn_for_a_student(settings, draw) -> None:
    config = DistillConfig(task="in_palm_rotate", seed=2, **settings)
    assert (config.draw or "").startswith(draw or "")
    assert (config.draw is None) == (draw is None)
    assert ("draw-" in config.name) == ("encoder_settings" in settings)


def test_students_of_another_version_of_the_tasks_are_left_out(tmp_path, caplog) -> None:
    _write(tmp_path, [0.8] * 3, observe="bool")
    _write(tmp_path, [0.6] * 3, observe="none")
    (path,) = tmp_path.glob("*_none_*/config.json")
    write_json(path, {**read_json(path), "task_version": 1})
    (found,) = read_results([tmp_path])
    assert found.config.observe == "bool"
    assert "another version of the tasks" in caplog.text
