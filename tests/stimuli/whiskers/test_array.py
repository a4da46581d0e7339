from __future__ import annotations

import csv
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.whiskers.array import WhiskerArray

MOUSE = WhiskerArray.mouse()
BOTH = WhiskerArray.mouse(side="both")


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("C2", ("C2",)),
        ("c2,D1", ("C2", "D1")),
        ("D1, C2", ("C2", "D1")),
        ("C0-C3", ("C0", "C1", "C2", "C3")),
        ("A1-E1", ("A1", "B1", "C1", "D1", "E1")),
        ("A*", ("A0", "A1", "A2", "A3", "A4")),
        ("*6", ("C6", "D6")),
        ("C2,C*", ("C0", "C1", "C2", "C3", "C4", "C5", "C6")),
    ],
)
def test_a_pattern_names_whiskers_in_the_order_of_the_array(pattern, names):
    assert MOUSE.select(pattern).names == names


def test_a_range_skips_gaps():
    assert WhiskerArray.rat().select("A4-E4").names == ("A4", "B4", "C4", "D4", "E4")
    assert MOUSE.select("A5-E5" if "A5" in MOUSE.names else "C5-E5").names == ("C5", "D5", "E5")


def test_with_both_sides_a_bare_name_means_both_and_a_prefix_one():
    assert BOTH.select("C2").names == ("RC2", "LC2")
    assert BOTH.select("RC2").names == ("C2",)
    assert BOTH.select("L*").side == "left"


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("C9", "Unknown whisker 'C9'; did you mean 'C"),
        ("C0-C9", "Unknown whisker 'C9'"),
        ("Z*", "Unknown whisker"),
        ("", "is empty; write 'all'"),
        (" , ", "is empty"),
        ("C3-C0", "must ascend within one row"),
        ("B1-C2", "must ascend within one row"),
    ],
)
def test_a_pattern_that_names_nothing_says_what_is_possible(pattern, message):
    with pytest.raises(UsageError, match=message):
        MOUSE.select(pattern)


@given(st.lists(st.sampled_from(MOUSE.names), min_size=1))
def test_any_list_of_names_selects_exactly_these(names):
    assert set(MOUSE.select(",".join(names)).names) == set(names)


@given(st.sampled_from(["C*", "C0-C3", "*2", "all", "C2,D1"]))
def test_selecting_twice_is_selecting_once(pattern):
    once = MOUSE.select(pattern)
    assert once.select(pattern if pattern != "C0-C3" else "all").names == once.names


ARRAYS = {"mouse": WhiskerArray.mouse, "rat": WhiskerArray.rat}


def _table(reference, species, name):
    with (reference / "whiskers" / species / f"{name}.csv").open() as stream:
        return list(csv.reader(stream))


@pytest.mark.shared
@pytest.mark.parametrize("species", ARRAYS)
def test_every_number_of_the_published_tables_is_reproduced_on_both_sides(reference, species):
    array = ARRAYS[species](side="both")
    names = [row[0] for row in _table(reference, species, "param_name")]
    assert list(array.names) == names
    grid = np.array(_table(reference, species, "param_side_row_col"), int)
    assert [(mount.side == "right", mount.row + 1, mount.col) for mount in array] == [tuple(row) for row in grid]
    shape = np.array(_table(reference, species, "param_s_a"), float)
    np.testing.assert_allclose([mount.whisker.arc_length * 1e3 for mount in array], shape[:, 0], rtol=1e-15)
    np.testing.assert_allclose([-mount.whisker.curvature / 1e3 for mount in array], shape[:, 1], rtol=1e-15)
    place = np.array(_table(reference, species, "param_bp_pos"), float)
    np.testing.assert_allclose([np.array(mount.position) * 1e3 for mount in array], place, rtol=1e-15)
    angles = np.array(_table(reference, species, "param_bp_angles"), float)
    np.testing.assert_allclose([mount.angles for mount in array], angles, rtol=1e-15)


@pytest.mark.shared
@pytest.mark.parametrize("species", ARRAYS)
def test_the_rest_shape_bends_as_the_published_link_angles(reference, species):
    # The tables hold the bend between 20 links of equal length, the first of which lies along the base axis.
    bends = np.array(_table(reference, species, "param_angles"), float)[:30]
    for mount, published in zip(ARRAYS[species](), bends, strict=True):
        points = mount.whisker.centre_line(np.linspace(0, mount.whisker.arc_length, 21))
        direction = np.arctan2(*np.diff(points, axis=0).T[::-1])
        np.testing.assert_allclose(direction[1:], np.cumsum(published)[1:], rtol=0.02)


def test_the_mouse_c2_has_the_dimensions_known_for_it():
    whisker = WhiskerArray.mouse()["C2"].whisker
    assert whisker.arc_length == pytest.approx(15.265e-3)
    assert whisker.base_radius == pytest.approx(0.048365e-3)
    assert whisker.tip_radius == pytest.approx(0.00878e-3, abs=1e-8)
    assert whisker.young_modulus == 5e9
    assert whisker.densities == (1260, 1690)
    assert whisker.damping_ratio == 0.32


@pytest.mark.parametrize("species", ARRAYS)
def test_no_tip_is_thinner_than_the_floor_and_every_whisker_tapers(species):
    for mount in ARRAYS[species]():
        assert 1.5e-6 <= mount.whisker.tip_radius < mount.whisker.base_radius


def test_the_mouse_fills_all_grid_cells_but_five():
    cells = {(mount.row, mount.col) for mount in WhiskerArray.mouse()}
    assert len(cells) == 30
    assert set(np.ndindex(5, 7)) - cells == {(0, 5), (0, 6), (1, 5), (1, 6), (4, 6)}


@pytest.mark.parametrize("species", ARRAYS)
def test_the_left_side_is_the_mirror_image_of_the_right_in_space(species):
    array = ARRAYS[species](side="both")
    s = np.linspace(0, 1, 7)
    flip = np.array([-1.0, 1.0, 1.0])
    for right, left in zip(array.mounts[:30], array.mounts[30:], strict=True):
        shapes = []
        for mount in (right, left):
            line = mount.whisker.centre_line(s * mount.whisker.arc_length)
            local = np.column_stack([line, np.zeros(len(s))])
            shapes.append(local @ base_rotation(mount.angles).T + mount.position)
        np.testing.assert_allclose(shapes[1], shapes[0] * flip, atol=1e-15)


def test_caudal_whiskers_point_backwards_outwards_and_rostral_ones_forwards():
    array = WhiskerArray.mouse()
    back, front = (base_rotation(array[name].angles)[:, 0] for name in ("C0", "C5"))
    assert back[0] > 0
    assert back[1] < 0
    assert front[0] > 0
    assert front[1] > 0


def test_switching_sides_and_back_changes_nothing():
    array = WhiskerArray.mouse()
    assert array.on_side("left").on_side("right") == array
    assert array.on_side("both").on_side("left") == WhiskerArray.mouse(side="left")
    with pytest.raises(UsageError, match="'lefty'; did you mean 'left'"):
        array.on_side("lefty")


def test_properties_of_selected_whiskers_can_be_replaced():
    array = WhiskerArray.mouse().replace("C*", young_modulus=3.3e9).replace("C2", angles=(1.0, 0.0, 0.0))
    assert array["C1"].whisker.young_modulus == 3.3e9
    assert array["C2"].angles == (1.0, 0.0, 0.0)
    assert array["D1"] == WhiskerArray.mouse()["D1"]
    with pytest.raises(UsageError, match="'youngs_modulus'; did you mean 'young_modulus'"):
        array.replace("C2", youngs_modulus=1.0)
    with pytest.raises(UsageError, match="Unknown whisker 'Q7'"):
        array["Q7"]


def test_the_published_angles_are_in_radians():
    assert all(abs(angle) < math.pi for mount in WhiskerArray.rat(side="both") for angle in mount.angles)


# Rows A, C and E, columns 0 to 6 of the model rat's tables in SeNSE-lab/whiskitphysics
# (code/data/whisker_param_model_rat/param_s_a.csv): arc length in mm and curvature in 1/mm depend on the column alone.
MODEL_RAT = [
    (53.835, 0.006352),
    (38.717, 0.009568),
    (27.845, 0.012784),
    (20.025, 0.016),
    (14.402, 0.019216),
    (10.358, 0.022432),
    (7.449, 0.025648),
]


def test_the_model_rat_has_the_published_arc_lengths_and_curvatures():
    model = WhiskerArray.rat(source="model")
    assert model.names == WhiskerArray.rat().names
    for mount in model:
        length, curvature = MODEL_RAT[mount.col]
        assert mount.whisker.arc_length * 1e3 == pytest.approx(length, abs=6e-4)
        assert -mount.whisker.curvature / 1e3 == pytest.approx(curvature, abs=1e-9)


def test_the_model_rat_lies_close_to_the_average_rat():
    model, average = WhiskerArray.rat(source="model"), WhiskerArray.rat()
    gap = [
        np.linalg.norm(np.subtract(first.position, second.position))
        for first, second in zip(model, average, strict=True)
    ]
    assert np.median(gap) < 1e-3
    assert max(gap) < 2.5e-3
    lengths = [
        (first.whisker.arc_length, second.whisker.arc_length) for first, second in zip(model, average, strict=True)
    ]
    assert np.corrcoef(np.log(lengths).T)[0, 1] > 0.95
    directions = [[base_rotation(mount.angles)[:, 0] for mount in array] for array in (model, average)]
    assert np.median(np.degrees(np.arccos(np.sum(np.multiply(*directions), axis=1)))) < 20


def test_the_mouse_has_no_model_equations_and_says_so():
    with pytest.raises(UsageError, match=r"mouse.*source='average'"):
        WhiskerArray.mouse(source="model")
    with pytest.raises(UsageError, match="'modell'; did you mean 'model'"):
        WhiskerArray.rat(source="modell")
