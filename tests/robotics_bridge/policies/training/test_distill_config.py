"""A student from its configuration alone."""

from __future__ import annotations

import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import hands
from robotics_bridge.hands.observations import OBSERVATIONS
from robotics_bridge.policies.training.distill import build_student
from robotics_bridge.policies.training.distill_config import PUBLISHED, DistillConfig, read_sweep


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"observe": "none", "encoder": "rnn"}, "'none' has no touch; leave out 'encoder'"),
        ({"observe": "none", "placement": "tips", "noisy": True}, "leave out 'placement', 'noisy'"),
        ({"observe": "none", "encoder_settings": {"seed": 1}}, "leave out 'encoder_settings'"),
        ({"noisy": "no"}, "'noisy' of a student must be True or False; received 'no'"),
        ({"encoder_settings": []}, "'encoder_settings' of a student must be names and values"),
        ({"placement": "tip"}, "did you mean 'tips'"),
        ({"resolution": "mid"}, "did you mean 'med'"),
        ({"teacher_iterations": 5}, "'teacher_share' falls, and that is 0"),
        ({"encoder": 5}, "'encoder' of a student must be a text; received 5"),
    ],
)
def test_settings_of_a_student_that_reach_nothing_are_refused(options, told) -> None:
    with pytest.raises(UsageError, match=told):
        DistillConfig(task="in_palm_rotate", **options)


ENTRY = '[[entries]]\ntask = "t"\nhand = "xhand1"\nplacements = ["tips"]\n'


@pytest.mark.shared
def test_the_published_sweep_is_the_product_that_the_released_settings_describe(reference) -> None:
    yaml = pytest.importorskip("yaml")
    document = yaml.safe_load((reference / "tasks" / "distill_configs.yaml").read_text())
    menu = document["defaults"]
    sweep = read_sweep()
    expected = set()
    for key, entry in document["configs"].items():
        if key.endswith("-models"):
            continue
        # Table 4.10 sweeps the placements of this file; none is added once per entry.
        expected.add((entry["task"], entry["robot"], "none", "hand", "med", False, entry["max_iters"]))
        expected |= {
            (entry["task"], entry["robot"], kind, placement, resolution, noisy, entry["max_iters"])
            for kind in menu["sensor_types"]
            for placement in entry["sensor_placements"]
            for resolution in menu["sensor_resolutions"]
            for noisy in menu["noisy_modes"]
        }
    found = {
        (s.task, s.hand, s.observe, s.placement, s.resolution, s.noisy, s.iterations)
        for s in sweep.students()
        if s.observe not in sweep.extra_types
    }
    assert found == expected
    assert (sweep.pinned.resolution, sweep.pinned.noisy) == (menu["pinned_resolution"], menu["pinned_noisy"])
    assert set(menu["tactile_encoders"]) <= {arm["encoder"] for arm in sweep.encoders.arms}


def test_its_counts_are_those_of_the_table() -> None:
    sweep = read_sweep(PUBLISHED)
    count = sweep.count()
    # in_palm_rotate: none + 7 types x 2 placements x 3 resolutions x 2; the other three entries have one placement.
    assert count["published"] == (1 + 7 * 2 * 3 * 2) + 3 * (1 + 7 * 3 * 2) == 214
    assert count["students"] == 214 + 2 * 3 * 2 + 3 * 3 * 2 == 244
    assert len(count["types"]) == 9
    assert sweep.count("types")["students"] == (1 + 8 * 2) + 3 * (1 + 8)
    assert sweep.count("force_torque")["students"] == (1 + 12) + 3 * (1 + 6)
    assert sweep.count("encoders")["students"] == 5 * len(sweep.encoders.arms)
    names = [student.name for student in sweep.students()]
    assert len(set(names)) == len(names)


def test_a_file_of_ones_own_expands_and_its_faults_are_named(tmp_path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f'types = ["bool"]\nseeds = [0, 1]\n[settings]\nnum_envs = 64\n{ENTRY}iterations = 5\n')
    students = read_sweep(path).students()
    assert [(s.observe, s.seed, s.num_envs, s.iterations) for s in students] == [
        ("none", 0, 64, 5), ("bool", 0, 64, 5), ("none", 1, 64, 5), ("bool", 1, 64, 5),
    ]  # fmt: skip
    for text, message in (
        (f'tpes = ["bool"]\n{ENTRY}', "did you mean 'types'"),
        (f'types = ["bol"]\n{ENTRY}', "did you mean 'bool'"),
        ('types = ["bool"]\n', "has no entries"),
        ('[[entries]]\ntask = "t"\nhand = "xhand1"\n', "needs 'placements'"),
        (f'types = ["bool"]\n{ENTRY}'.replace("tips", "tip"), "did you mean 'tips'"),
        (f'[encoders]\narms = [{{learning = "frozen"}}]\n{ENTRY}', "names no 'encoder'"),
    ):
        path.write_text(text)
        with pytest.raises(UsageError, match=message):
            read_sweep(path)
    path.write_text("types = [")
    with pytest.raises(DataError, match=r"mine\.toml' .*TOML"):
        read_sweep(path)
    with pytest.raises(DataError, match=r"/none\.toml'"):
        read_sweep(tmp_path / "none.toml")
    with pytest.raises(UsageError, match="did you mean 'types'"):
        read_sweep().students("type")


def test_a_sweep_may_name_a_probe_file_in_place_of_a_resolution(tmp_path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('types = ["force_torque"]\nresolutions = ["med", "some/fifty.json"]\n' + ENTRY)
    _, one, other = read_sweep(path).students("force_torque")
    assert (one.resolution, other.resolution) == ("med", "some/fifty.json")
    assert "_fifty_" in other.name


def test_students_of_every_subset_are_looked_at_when_a_sweep_is_read(tmp_path) -> None:
    path = tmp_path / "s.toml"
    encoders = '[encoders]\ntypes = ["force_torque"]\narms = [{encoder = "mlp", time = "resampled"}]\n'
    path.write_text(f"{encoders}{ENTRY}")
    with pytest.raises(UsageError, match=r"'time' = 'resampled' is for .*'mlp'"):
        read_sweep(path)
    path.write_text(f'types = ["bool"]\n[pinned]\nnoisy = "no"\n{ENTRY}')
    with pytest.raises(UsageError, match=r"'noisy' of \[pinned\] of the sweep 's\.toml' must be True or False"):
        read_sweep(path)
    path.write_text(f'types = ["bool"]\n[settings]\nencoder = "rnn"\n{ENTRY}')
    assert [student.encoder for student in read_sweep(path).students()] == ["auto", "rnn"]


def test_a_sweep_may_list_its_students_one_by_one(tmp_path) -> None:
    path = tmp_path / "s.toml"
    entry = ENTRY.replace('placements = ["tips"]\n', "")
    some = '[[students]]\nobserve = "none"\n[[students]]\nobserve = "bool"\nplacement = "tips"\nhidden = [8, 8]\n'
    path.write_text(f"seeds = [0, 1]\n[settings]\nnum_envs = 64\n{entry}{some}")
    sweep = read_sweep(path)
    assert [(s.observe, s.seed, s.num_envs, s.hidden[0]) for s in sweep.students()] == [
        ("none", 0, 64, 512), ("bool", 0, 64, 8), ("none", 1, 64, 512), ("bool", 1, 64, 8),
    ]  # fmt: skip
    assert [s.seed for s in sweep.students("bool")] == [0, 1]
    with pytest.raises(UsageError, match="did you mean 'bool'"):
        sweep.students("bol")
    for text, message in (
        (f'types = ["bool"]\n{entry}{some}', r"lists its students one by one has no 'types'"),
        (f"{ENTRY}{some}", "has no 'placements'"),
        (f"noisy = [true]\n{entry}{some}", "has no 'noisy'"),
        (f'{entry}[[students]]\nobserv = "bool"\n', "did you mean 'observe'"),
        (f"{entry}{some}{some}", "twice"),
    ):
        path.write_text(text)
        with pytest.raises(UsageError, match=message):
            read_sweep(path)


def test_students_of_the_comparison_of_touch_have_equally_many_parameters() -> None:
    sweep = read_sweep("placement-and-type")
    students = [student for student in sweep.students() if student.seed == 0]
    later = [student for student in read_sweep("noise-resolution-law").students() if student.seed == 0]
    assert not {student.name for student in later} & {student.name for student in students}
    assert {student.law for student in later} == {"task", "published"}
    arms = {(student.observe, student.placement) for student in students if student.observe != "none"}
    assert arms == {(kind, place) for kind in OBSERVATIONS if kind != "none" for place in ("hand", "tips")}
    other = [student for student in read_sweep("screwdriver-fingers").students() if student.seed == 0]
    assert {student.observe for student in other} == set(OBSERVATIONS)
    counts = []
    for student in (*students, *later, *other):
        shapes = {"proprio": (29,), "command": (1,)}
        if student.tactile is not None:
            shapes["tactile"] = student.tactile.build().shape
        policy = build_student(student, shapes, list(shapes), len(hands.load("xhand1").joints) - 7)
        counts.append(sum(weight.numel() for weight in policy.parameters() if weight.requires_grad))
    assert max(counts) < 1.01 * min(counts)
