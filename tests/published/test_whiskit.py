from __future__ import annotations

import csv
import json
import math
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.published.conversion import FRAME_STATUSES
from brainbench.published.whiskit import (
    bends,
    find_runs,
    load_bends,
    load_parameters,
    published_cleaning,
    read_run,
    read_runs,
    save_parameters,
    save_run,
)
from brainbench.stimuli import read_stimulus_set, to_grid, write_stimulus_set
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.published_files import write_run

TABLES = ("param_name", "param_side_row_col", "param_s_a", "param_bp_pos", "param_bp_angles", "param_angles")


@pytest.mark.shared
@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_published_folders_survive_reading_and_writing_byte_for_byte(reference, tmp_path, species):
    source = reference / "whiskers" / species
    array = load_parameters(source)
    save_parameters(array, tmp_path, bends_table=load_bends(source))
    for name in TABLES:
        assert (tmp_path / f"{name}.csv").read_bytes() == (source / f"{name}.csv").read_bytes(), name
    assert load_parameters(tmp_path).mounts == array.mounts


@pytest.mark.shared
@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_a_published_folder_is_the_array_of_that_species(reference, species):
    made = {"mouse": WhiskerArray.mouse, "rat": WhiskerArray.rat}[species](side="both")
    assert load_parameters(reference / "whiskers" / species).mounts == made.mounts


@pytest.mark.shared
@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_bends_of_the_exact_parabola_are_the_published_ones_within_two_percent(reference, species):
    published = load_bends(reference / "whiskers" / species)
    ours = bends(load_parameters(reference / "whiskers" / species))
    assert (ours[:, 0] == 0).all()
    np.testing.assert_allclose(np.cumsum(ours, axis=1)[:, 1:], np.cumsum(published, axis=1)[:, 1:], rtol=0.02)


@pytest.mark.shared
def test_no_number_of_links_loses_curvature_as_reused_bend_tables_do(reference):
    """The released simulator cuts int(length in mm) links and takes as many of the 20 bends: short ones straighten."""
    array = WhiskerArray.mouse()
    published = load_bends(reference / "whiskers" / "mouse")[:30]
    lost = []
    for mount, table in zip(array, published, strict=True):
        whisker = mount.whisker
        links = int(whisker.arc_length * 1e3)
        lost.append(1 - table[:links].sum() / table.sum())
        for count in (2, links, 20, 60):
            chain = build_chain(whisker, count)
            # The last link points as the parabola does in its middle, and the tip lies where the parabola ends.
            middle = float(whisker.tangent_angle(whisker.arc_length * (1 - 0.5 / count)))
            assert chain.rest_angles.sum() == pytest.approx(middle, rel=0.02)
            np.testing.assert_allclose(chain.points[-1, :2], whisker.centre_line(whisker.arc_length), atol=1e-12)
    assert lost[array.names.index("E5")] > 0.7
    assert max(lost) > 0.7


def test_an_array_survives_writing_and_reading(tmp_path):
    array = WhiskerArray.rat(side="left", whiskers="B*,E6")
    again = load_parameters(save_parameters(array, tmp_path / "new" / "folder"), species="rat")
    assert again.names == array.names
    for first, second in zip(array, again, strict=True):
        np.testing.assert_allclose(second.position, first.position, rtol=1e-11)
        np.testing.assert_allclose(second.angles, first.angles, rtol=1e-11)
        assert second.whisker.arc_length == pytest.approx(first.whisker.arc_length, rel=1e-11)
        assert second.whisker.curvature == pytest.approx(first.whisker.curvature, rel=1e-11)
    np.testing.assert_allclose(load_bends(tmp_path / "new" / "folder"), bends(array), rtol=1e-10, atol=1e-15)


@given(st.integers(2, 40))
def test_bends_add_up_to_the_direction_of_the_last_link(links):
    array = WhiskerArray.mouse(whiskers="C2,E5")
    for mount, row in zip(array, bends(array, links), strict=True):
        points = mount.whisker.centre_line(np.linspace(0, mount.whisker.arc_length, links + 1))
        assert row.sum() == pytest.approx(np.arctan2(*(points[-1] - points[-2])[::-1]))


def _spoil(folder, name, text):
    (folder / f"{name}.csv").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("param_name", "RC2\nRC1\n", r"param_name .*'RC2' .*param_side_row_col .*'RC1'"),
        ("param_name", "RC1\n", r"param_side_row_col.* has shape \[2, 3\]; 1 names need \[1, 3\]"),
        ("param_s_a", "1,2\n3\n", "param_s_a"),
        ("param_s_a", "a,2\n3,4\n", "param_s_a"),
        ("param_bp_pos", "1,2\n3,4\n", r"shape \[2, 2\]; 2 names need \[2, 3\]"),
        ("param_side_row_col", "1,9,1\n1,3,2\n", r"says 'R\?1'"),
    ],
)
def test_folders_that_do_not_fit_together_are_refused(tmp_path, name, text, message):
    save_parameters(WhiskerArray.mouse(whiskers="C1,C2"), tmp_path)
    _spoil(tmp_path, name, text)
    with pytest.raises(DataError, match=message):
        load_parameters(tmp_path)


def test_a_missing_table_is_named(tmp_path):
    with pytest.raises(DataFileNotFoundError, match=r"/param_name\.csv'"):
        load_parameters(tmp_path)
    save_parameters(WhiskerArray.mouse(whiskers="C1"), tmp_path)
    shutil.move(tmp_path / "param_s_a.csv", tmp_path / "elsewhere.csv")
    with pytest.raises(DataFileNotFoundError, match=r"/param_s_a\.csv'"):
        load_parameters(tmp_path)
    with pytest.raises(UsageError, match=r"bends .*received \(2, 20\)"):
        save_parameters(WhiskerArray.mouse(whiskers="C1"), tmp_path, bends_table=np.zeros((2, 20)))


@pytest.fixture(scope="module")
def run():
    """A simulated scene, its stimulus set and the shapes of its whiskers in the world."""
    ball = PlacedObject(sphere(2e-3), position=(0.012, 0.004, 0.0065), friction=0.2)
    array = WhiskerArray.mouse(whiskers="C1,C2")
    scene = Scene("ball", array, (ball,), frames=Frames(0.01, 0.005, 16))
    dataset = simulate(scene, fidelity=Fidelity.preset("fast"), cache=False)
    traces = get_engine("mujoco").run(scene.jobs(), Fidelity.preset("fast"), record_shape=True)
    return dataset, [trace.link_positions for trace in traces]


def _sense_lab_read(path):
    """Read as SeNSE-lab's readers do: whatever follows the last comma of a line is dropped."""
    with path.open(newline="") as stream:
        return np.array([[float(cell) for cell in row[:-1]] for row in csv.reader(stream)])


def test_forces_are_written_in_millinewtons_as_both_kinds_of_readers_expect(tmp_path, run):
    dataset, _ = run
    wrench = dataset["wrench"].values[0]
    save_run(dataset, tmp_path / "a")
    save_run(dataset, tmp_path / "b", dialect="thesis")
    for index, channel in enumerate(["Fx", "Fy", "Fz", "Mx", "My", "Mz"]):
        scale = 1e3 if index < 3 else 1e6
        first = _sense_lab_read(tmp_path / "a" / "dynamics" / f"{channel}.csv")
        second = np.loadtxt(tmp_path / "b" / "dynamics" / f"{channel}.csv", delimiter=",")
        np.testing.assert_allclose(first, wrench[:, :, index] * scale, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(first, second)
    assert (tmp_path / "b" / "whisker_ID.csv").read_text() == "RC1\nRC2\n"
    assert (tmp_path / "a" / "whisker_ID.csv").read_text() == "RC1,\nRC2,\n"
    assert not (tmp_path / "a" / "kinematics").exists()


def test_shapes_and_contacts_are_written_per_whisker(tmp_path, run):
    dataset, shapes = run
    save_run(dataset, tmp_path, shapes=shapes)
    links = shapes[1].shape[1] - 1
    x, y, z = (_sense_lab_read(tmp_path / "kinematics" / axis / "RC2.csv") for axis in "xyz")
    assert x.shape == (16, links + 1)
    np.testing.assert_allclose(np.stack([x, y, z], axis=-1)[:, 0], shapes[1][:, 0] * 1e3, rtol=1e-6)
    np.testing.assert_allclose(x[:, 1], (shapes[1][:, 0, 0] + shapes[1][:, 1, 0]) / 2 * 1e3, rtol=1e-6)
    flags = _sense_lab_read(tmp_path / "kinematics" / "c" / "RC2.csv")
    touched = dataset["contact"].sel(whisker="C2").values[0]
    assert touched.any()
    np.testing.assert_array_equal(flags.sum(axis=1) > 0, touched)
    arc = dataset["contact_arc"].sel(whisker="C2").values[0][touched]
    length = WhiskerArray.mouse()["C2"].whisker.arc_length
    np.testing.assert_allclose((flags[touched].argmax(axis=1) + 0.5) / links * length, arc, atol=0.51 * length / links)


def test_a_run_that_cannot_be_written_says_why(tmp_path, run):
    dataset, shapes = run
    with pytest.raises(UsageError, match="'bal'; did you mean 'ball'"):
        save_run(dataset, tmp_path, stimulus="bal")
    with pytest.raises(UsageError, match="did you mean 'thesis'"):
        save_run(dataset, tmp_path, dialect="tesis")
    with pytest.raises(UsageError, match=r"2 whiskers .*received 1"):
        save_run(dataset, tmp_path, shapes=shapes[:1])
    with pytest.raises(UsageError, match=r"RC1 .*received \(3, 9, 3\)"):
        save_run(dataset, tmp_path, shapes=[shape[:3] for shape in shapes])
    with pytest.raises(UsageError, match="several animals"):
        save_run(dataset.isel(whisker=[0, 0]).assign_coords(whisker=["a:C1", "b:C1"]), tmp_path)
    with pytest.raises(UsageError, match=r"WHISKiT.*need"):
        save_run(dataset.drop_vars("side"), tmp_path)
    both = dataset.isel(stimulus=[0, 0]).assign_coords(stimulus=["a", "b"])
    with pytest.raises(UsageError, match=r"Name one stimulus.*'a', 'b'"):
        save_run(both, tmp_path)
    assert save_run(both, tmp_path / "b", stimulus="b").is_dir()


NAMES = ("RC1", "RC2")


def _dynamics(rows=110, seed=0, whiskers=2):
    return np.round(np.random.default_rng(seed).normal(size=(rows, whiskers, 6)), 4)


@pytest.mark.shared
def test_the_cleaned_reference_run_is_the_published_sweep_to_the_bit(reference):
    (folder,) = find_runs(reference / "published" / "whiskit_run")
    with np.load(reference / "published" / "sweep_example_110hz.npz") as stored:
        data = stored["data"]
    expected = np.delete(data, [5, 6, 12, 13, 34], axis=1)
    np.testing.assert_array_equal(published_cleaning(read_run(folder).dynamics), expected)
    found = read_runs([folder], cleaning="published")
    np.testing.assert_allclose(found["wrench"].values[0], expected * np.repeat([1e-3, 1e-6], 3), rtol=1e-7)
    # The input of a network, by the layout of the reference: channel 6 · sub-step + component.
    grid = (data * np.repeat([1e-3, 1e-6], 3)).reshape(22, 5, 5, 7, 6).transpose(0, 1, 4, 2, 3)
    np.testing.assert_allclose(to_grid(found)[0], grid.reshape(22, 30, 5, 7), rtol=1e-6)


@pytest.mark.shared
def test_faults_of_the_reference_run_stand_where_its_manifest_says(reference):
    found = read_runs(find_runs(reference / "published" / "whiskit_run"))
    status = found["frame_status"].values[0]
    expected = np.zeros((110, 30), dtype=int)
    expected[0] = FRAME_STATUSES.index("unwritten")
    expected[40:43, 7] = expected[:2, 20] = FRAME_STATUSES.index("missing")
    expected[60, 12] = expected[0, 3] = expected[70, 25] = FRAME_STATUSES.index("too large")
    np.testing.assert_array_equal(status, expected)
    assert json.loads(found.attrs["faults"]) == {"h-3-to12-t90-v30-s40": {"missing": 30, "too large": 13}}
    assert np.isnan(found["wrench"].values).sum() == 43
    bad = [str(name) for name in found["whisker"].values[found["status"].values[0] != "ok"]]
    assert bad == ["A3", "B2", "C2", "D3", "E1"]
    with pytest.raises(DataError, match="A3 in h-3-to12-t90-v30-s40"):
        to_grid(found)


def test_a_run_is_read_in_newtons_and_seconds(tmp_path):
    raw = _dynamics()
    raw[0] = 0.0
    found = read_runs([write_run(tmp_path / "a", raw, ("RE0", "LC2"))])
    np.testing.assert_allclose(found["wrench"].values[0], raw * np.repeat([1e-3, 1e-6], 3), rtol=1e-7)
    np.testing.assert_allclose(found["time"].values, np.arange(110) / 110)
    assert [str(found[name].values[0]) for name in ("whisker", "row", "col", "side")] == ["E0", "4", "0", "right"]
    assert [str(found[name].values[1]) for name in ("whisker", "row", "col", "side")] == ["C2", "2", "2", "left"]
    assert (found["status"].values == "ok").all()
    assert "contact" not in found


def test_bad_values_are_missing_and_their_frames_marked(tmp_path):
    raw = _dynamics()
    raw[4, 0, 2], raw[5, 1, 0], raw[6, 1, 3], raw[0, 0, 0] = -math.nan, math.inf, -1000.5, 0.5
    found = read_runs([write_run(tmp_path / "a", raw)])
    missing = np.argwhere(np.isnan(found["wrench"].values[0])).tolist()
    assert missing == [[4, 0, 2], [5, 1, 0], [6, 1, 3]]
    marked = [[FRAME_STATUSES[code] for code in row] for row in found["frame_status"].values[0, [0, 4, 5, 6, 7]]]
    assert marked == [["unwritten"] * 2, ["missing", "ok"], ["ok", "too large"], ["ok", "too large"], ["ok", "ok"]]
    assert json.loads(found.attrs["faults"])["a"] == {"missing": 1, "too large": 2, "unwritten": 12}
    assert "missing: 1" in str(found["reason"].values[0, 0])


def test_the_published_cleaning_keeps_every_ninth_of_1000_rows_and_fills_from_the_last_good_one():
    raw = _dynamics(1000)
    raw[1, 0, 0], raw[10, 0, 0], raw[19, 0, 1], raw[28, 0, 1], raw[37, 0, 1], raw[46, 1, 5] = (
        2e3, math.inf, math.nan, 1e4, -1e4, math.nan,
    )  # fmt: skip
    expected = raw[1:983:9].copy()
    expected[[0, 1], 0, 0] = 0.0  # nothing good before
    expected[[2, 3, 4], 0, 1] = 0.0  # a missing value becomes 0, which is then the last good one
    expected[5, 1, 5] = 0.0
    np.testing.assert_array_equal(published_cleaning(raw), expected)
    with pytest.raises(UsageError, match="900"):
        published_cleaning(raw[:900])


def test_runs_of_1000_rows_are_milliseconds_and_cleaned_ones_9_ms_apart(tmp_path):
    folder = write_run(tmp_path / "a", _dynamics(1000))
    np.testing.assert_allclose(read_runs([folder])["time"].values, np.arange(1000) / 1000)
    cleaned = read_runs([folder], cleaning="published")
    np.testing.assert_allclose(cleaned["time"].values, 0.001 + 0.009 * np.arange(110))
    np.testing.assert_allclose(cleaned["wrench"].values[0, 3, 1, 4], _dynamics(1000)[28, 1, 4] * 1e-6)
    assert not cleaned["frame_status"].values.any()


def test_many_runs_make_one_set_and_a_set_becomes_runs_again(tmp_path):
    for index in range(3):
        write_run(tmp_path / "runs" / f"run-{index}", _dynamics(seed=index))
    (tmp_path / "runs" / "notes").mkdir()
    found = read_runs(find_runs(tmp_path / "runs"))
    assert [str(label) for label in found["stimulus"].values] == ["run-0", "run-1", "run-2"]
    again = read_stimulus_set(write_stimulus_set(found, tmp_path / "set.h5"))
    back = save_run(again, tmp_path / "back" / "run-1", stimulus="run-1", dialect="thesis")
    np.testing.assert_allclose(read_run(back).dynamics, _dynamics(seed=1), rtol=2e-7)
    assert read_run(back).names == NAMES


def test_runs_of_several_objects_are_called_by_their_paths(tmp_path):
    for name in ("mug/1/h0", "mug/2/h0"):
        write_run(tmp_path / name, _dynamics())
    labels = read_runs(find_runs(tmp_path))["stimulus"].values
    assert [str(label) for label in labels] == ["1/h0", "2/h0"]


def test_contacts_of_the_kinematics_are_kept(tmp_path):
    folder = write_run(tmp_path / "a", _dynamics())
    (folder / "kinematics" / "c").mkdir(parents=True)
    flags = np.zeros((110, 5), dtype=int)
    flags[30:40, 2] = 1
    for name in NAMES:
        np.savetxt(folder / "kinematics" / "c" / f"{name}.csv", flags, delimiter=",", fmt="%d")
    touched = read_runs([folder])["contact"].values[0]
    np.testing.assert_array_equal(touched, np.repeat(flags.any(axis=1)[:, None], 2, axis=1))
    np.savetxt(folder / "kinematics" / "c" / "RC2.csv", flags[:50], delimiter=",", fmt="%d")
    with pytest.raises(DataError, match=r"RC2\.csv"):
        read_runs([folder])


def _shorten(folder):
    path = folder / "dynamics" / "Fz.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:50]))


def _narrow(folder):
    np.savetxt(folder / "dynamics" / "My.csv", _dynamics()[:, :1, 0], delimiter=",")


@pytest.mark.parametrize(
    ("spoil", "culprit"),
    [
        (_shorten, r"Fz\.csv.* has 50 rows; it needs 110"),
        (_narrow, r"My\.csv.* has 1 columns; it needs 2"),
        (lambda folder: (folder / "dynamics" / "Mx.csv").unlink(), r"Mx\.csv"),
        (lambda folder: (folder / "dynamics" / "Mx.csv").write_text("1,x\n"), r"Mx\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").unlink(), r"whisker_ID\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").write_bytes(b"\xff\xfe"), r"whisker_ID\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").write_text("RC1\nRF2\n"), "'RF2'.* did you mean 'R.2'"),
        (lambda folder: (folder / "whisker_ID.csv").write_text("RC1\nRC1\n"), "once"),
    ],
)
def test_a_run_that_does_not_fit_together_names_its_file(tmp_path, spoil, culprit):
    spoil(folder := write_run(tmp_path / "run", _dynamics()))
    with pytest.raises(DataError, match=culprit):
        read_run(folder)


def test_runs_that_do_not_fit_one_another_are_refused(tmp_path):
    first = write_run(tmp_path / "a", _dynamics())
    with pytest.raises(DataError, match=r"'a' and 'b' .*110 and 100 rows"):
        read_runs([first, write_run(tmp_path / "b", _dynamics(100))])
    with pytest.raises(DataError, match="whisker_ID"):
        read_runs(find_runs(tmp_path / "b" / "dynamics"))
    with pytest.raises(UsageError, match="100 rows"):
        read_runs([tmp_path / "b"])
    assert read_runs([tmp_path / "b"], rate=200.0)["time"].values[-1] == pytest.approx(99 / 200)
    with pytest.raises(UsageError, match="-1"):
        read_runs([first], rate=-1.0)
    with pytest.raises(UsageError, match="did you mean 'published'"):
        read_runs([first], cleaning="publish")
    (tmp_path / "c" / "dynamics").mkdir(parents=True)
    (tmp_path / "c" / "whisker_ID.csv").write_text("RC1\n")
    with pytest.raises(DataFileNotFoundError, match=r"Fx\.csv"):
        read_runs(find_runs(tmp_path / "c"))
