import csv
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import sphere
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskit import bends, load_bends, load_parameters, save_parameters, save_run

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
            np.testing.assert_allclose(chain.points[-1], whisker.centre_line(whisker.arc_length), atol=1e-12)
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
