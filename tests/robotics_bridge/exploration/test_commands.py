"""``brainbench stimuli hand``."""

from __future__ import annotations

import json

import numpy as np

from brainbench.stimuli import load_stimuli


def test_hand_stimuli_carry_the_labels_of_the_whisker_recipe_and_load_like_it(run, tmp_path):
    path = tmp_path / "hand.h5"
    arguments = ["--objects", "rodgers", "--procedure", "lateral_motion", "--frames", "60", "--resolution", "low"]
    found = run("stimuli", "hand", *arguments, "--out", str(path), "--json")
    assert found.status == 0, found.err
    facts = json.loads(found.out)
    assert [item["stimulus"] for item in facts["stimuli"]] == [
        f"{side}-{distance}" for side in ("convex", "concave") for distance in ("close", "medium", "far")
    ]
    assert all(item["sites_touched"] for item in facts["stimuli"])
    stimuli = load_stimuli(path)
    assert stimuli.input.shape == (6, 12, 30, 5, 7)
    assert stimuli.content_hash == facts["content_hash"]
    assert np.abs(stimuli.input).max() > 0


def test_objects_and_frames_that_do_not_exist_are_explained(run):
    found = run("stimuli", "hand", "--objects", "toruss")
    assert found.status == 2
    assert "torus" in found.err
    assert "must be a finite number, above 0" in run("stimuli", "hand", "--objects", "torus", "--diagonal", "-50").err
    assert "multiple of 5" in run("stimuli", "hand", "--frames", "7").err
