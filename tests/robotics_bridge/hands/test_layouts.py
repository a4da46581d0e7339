"""Layouts of probes: published counts and files."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import hands
from robotics_bridge.hands.layouts import RESOLUTIONS, active_count, fillers, read_probes, write_probes

COUNTS = {
    ("xhand1", "low"): (90, 45, 78, 12),
    ("xhand1", "med"): (199, 100, 164, 35),
    ("xhand1", "high"): (667, 224, 448, 219),
    ("sharpa", "low"): (98, 45, 89, 9),
    ("sharpa", "med"): (206, 70, 190, 16),
    ("sharpa", "high"): (781, 245, 660, 121),
}


@pytest.mark.parametrize(("name", "resolution"), list(COUNTS))
def test_layouts_have_exactly_the_published_counts(name, resolution):
    hand = hands.load(name)
    counts = tuple(active_count(hand.layout(resolution, place)) for place in ("hand", "tips", "fingers", "palm"))
    assert counts == COUNTS[name, resolution]


@pytest.mark.parametrize("name", hands.list_hands())
def test_every_probe_lies_on_its_link_and_looks_away_from_it(name):
    hand = hands.load(name)
    data = mujoco.MjData(hand.model)
    mujoco.mj_forward(hand.model, data)
    for link, probes in hand.layout("high").items():
        body = hand.model.body(link).id
        geom = int(hand.model.body_geomadr[body])
        place, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        world = data.xpos[body] + probes.position @ data.xmat[body].reshape(3, 3).T
        normal = probes.normal @ data.xmat[body].reshape(3, 3).T
        for step, inside in ((1e-6, False), (-1e-6, True)):
            local = (world + step * normal - place) @ turn
            size = hand.model.geom_size[geom]
            if hand.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                within = (np.abs(local) <= size).all(axis=1)
            else:
                on_axis = np.clip(local[:, 2], -size[1], size[1])
                within = np.linalg.norm(local - np.outer(on_axis, [0, 0, 1]), axis=1) <= size[0]
            assert (within == inside).all(), (link, step)


@pytest.mark.shared
@pytest.mark.parametrize("name", hands.list_hands())
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_published_probe_files_are_read_with_their_counts_and_links(name, resolution, reference):
    path = next((reference / "tactile" / name / resolution).glob("probes_*.json"))
    hand = hands.load(name).with_probes(path)
    counts = tuple(active_count(hand.layout("custom", place)) for place in ("hand", "tips", "fingers", "palm"))
    assert counts == COUNTS[name, resolution]
    for link, probes in hand.layout("custom").items():
        assert probes.shape == hand.layout(resolution)[link].shape or len(probes) == len(hand.layout(resolution)[link])


def test_a_layout_survives_its_file(tmp_path):
    layout = hands.load("sharpa").layout("high")
    write_probes(tmp_path / "probes.json", layout)
    again = read_probes(tmp_path / "probes.json")
    assert list(again) == list(layout)
    for link, probes in layout.items():
        assert again[link].shape == probes.shape
        assert again[link].position == pytest.approx(probes.position)
        assert again[link].radius == pytest.approx(probes.radius)


def test_fillers_are_the_far_corners():
    assert fillers(7, 7, 2).tolist() == [6, 48]
    assert len(set(fillers(8, 8, 5).tolist())) == 5
    assert fillers(4, 4, 0).size == 0


def test_probe_files_of_another_form_or_for_another_hand_are_refused(tmp_path):
    path = tmp_path / "probes.json"
    path.write_text('{"a": 1}')
    with pytest.raises(DataError, match=r"probes\.json .*'link_name'"):
        read_probes(path)
    path.write_text('[{"link_name": "a", "probes": [[{"radius": 1}]]}]')
    with pytest.raises(DataError, match="link 1"):
        read_probes(path)
    write_probes(path, hands.load("sharpa").layout("low"))
    with pytest.raises(UsageError, match="'right_hand_C_MC'; did you mean"):
        hands.load("xhand1").with_probes(path)
