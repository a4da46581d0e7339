"""Distances of traced points from simulated curves are those of the curve, not of the links' polygon."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.fitting.curves import normal_offsets
from brainbench.stimuli.whiskers.chain import build_chain

WHISKER = WhiskerArray.of("rat")["C2"].whisker


def _joints(links):
    chain = build_chain(WHISKER, links)
    return chain.nodes, chain.points[None]


@pytest.mark.parametrize("links", [10, 20])
def test_points_of_the_curve_have_no_distance_although_the_chords_do(links):
    nodes, joints = _joints(links)
    points = WHISKER.centre_line(np.linspace(0.0005, 0.031, 77))[None]
    offsets = normal_offsets(nodes, joints, points)
    sagitta = 2 * abs(WHISKER.curvature) * (WHISKER.arc_length / links) ** 2 / 8
    assert np.abs(offsets).max() < 0.01 * sagitta


def test_the_distance_is_signed_and_across_the_curve():
    nodes, joints = _joints(20)
    s = np.linspace(0.002, 0.03, 15)
    angle = WHISKER.tangent_angle(s)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # A point to the left of the curve: the curve lies to its right, at minus the distance.
    points = (WHISKER.centre_line(s) + 1e-4 * normal + 1e-5 * along)[None]
    np.testing.assert_allclose(normal_offsets(nodes, joints, points)[0, :, 0], -1e-4, atol=1e-8)


def test_in_space_there_are_two_distances_of_the_same_length():
    nodes, joints = _joints(20)
    space = np.pad(joints, ((0, 0), (0, 0), (0, 1)))
    s = np.linspace(0.002, 0.03, 9)
    points = np.pad(WHISKER.centre_line(s), ((0, 0), (0, 1)))[None] + np.array([0, 0, 3e-5])
    offsets = normal_offsets(nodes, space, points)
    assert offsets.shape == (1, 9, 2)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 3e-5, rtol=1e-6)
    np.testing.assert_allclose(offsets[..., 1], -3e-5, rtol=1e-6)


def test_missing_points_and_lost_frames_are_missing():
    nodes, joints = _joints(10)
    both = np.concatenate([joints, np.full_like(joints, np.nan)])
    points = np.repeat(WHISKER.centre_line(np.array([0.005, 0.01, 0.02]))[None], 2, axis=0)
    points[0, 1] = np.nan
    offsets = normal_offsets(nodes, both, points)[..., 0]
    assert np.isnan(offsets).tolist() == [[False, True, False], [True, True, True]]
