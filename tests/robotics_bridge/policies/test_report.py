"""Comparing students."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from brainbench.errors import DataError
from brainbench.files import write_json
from leaderboards import rank, read_record, write_record
from robotics_bridge.policies.distill_config import DistillConfig
from robotics_bridge.policies.report import COLUMNS, draw, read_results, records, rows


def _write(folder, shares, *, seed=0, **changes) -> None:
    config = DistillConfig(task="in_palm_rotate", seed=seed, **changes)
    write_json(folder / config.name / "config.json", {"distill": config.plain()})
    found = [
        {"seed": index, "success": [float(i < round(20 * share)) for i in range(20)], "metric": [share] * 20}
        for index, share in enumerate(shares)
    ]
    write_json(folder / config.name / "evaluation.json", found)


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
    assert (felt.interval.low, felt.interval.high) == pytest.approx(tuple(reference))
    paired = stats.ttest_rel([0.8, 0.9, 0.7], [0.5, 0.55, 0.45]).confidence_interval()
    assert felt.difference is not None
    assert (felt.difference.low, felt.difference.high) == pytest.approx(tuple(paired))
    assert felt.episodes == 180
    assert not felt.note
    table = rows([felt, bare])
    assert len(table[0]) == len(COLUMNS)
    assert table[0][-1].startswith("+0.300")


def test_a_single_student_is_said_to_be_one(tmp_path) -> None:
    _write(tmp_path, [0.5, 0.6, 0.7], observe="bool", placement="tips")
    (only,) = read_results([tmp_path])
    assert only.value == pytest.approx(0.6)
    assert "chance in evaluation alone" in only.note
    assert only.interval is not None
    expected = stats.binomtest(36, 60).proportion_ci(method="wilson")
    assert (only.interval.low, only.interval.high) == pytest.approx((expected.low, expected.high), abs=1e-6)
    assert records([only])[0].score.status == "unreliable"


def test_records_make_a_board_of_the_leaderboard(tmp_path) -> None:
    _three_seeds(tmp_path / "runs")
    found = records(read_results([tmp_path / "runs"]))
    stored = [read_record(write_record(record, tmp_path / "records")) for record in found]
    (board,) = rank(stored)
    assert board.recordings == "in_palm_rotate on xhand1 (default)"
    assert "force_torque" in board.rows[0].record.score.name
    assert board.rows[0].first == 1


def test_the_picture_shows_every_group(tmp_path) -> None:
    _three_seeds(tmp_path)
    from PIL import Image

    path = draw(read_results([tmp_path]), tmp_path / "report.png")
    assert np.ptp(np.asarray(Image.open(path).convert("L"))) > 100


def test_missing_and_damaged_evaluations_are_named(tmp_path) -> None:
    with pytest.raises(DataError, match="No evaluated student"):
        read_results([tmp_path])
    _write(tmp_path, [0.5])
    path = next(tmp_path.rglob("evaluation.json"))
    path.write_text('[{"seed": 0}]')
    with pytest.raises(DataError, match="without 'seed' or 'success'"):
        read_results([tmp_path])
