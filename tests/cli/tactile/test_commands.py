import json
from pathlib import Path

from tests.factories.hand_gallery import GALLERY


def test_layouts_prints_the_counts_of_the_published_table(run):
    found = json.loads(run("tactile", "layouts", "--hand", "sharpa", "--json").out)
    assert found["counts"]["med"] == {"hand": 206, "tips": 70, "fingers": 190, "palm": 16}
    assert len(found["joints"]) == 22
    (thumb,) = [
        row
        for row in json.loads(run("tactile", "layouts", "--links", "--json").out)["links"]
        if (row["resolution"], row["link"]) == ("high", "right_hand_thumb_rota_link2")
    ]
    assert 0 < thumb["active"] <= thumb["shape"][0] * thumb["shape"][1]
    assert all(0 < radius < 0.01 for radius in thumb["radius"])
    text = run("tactile", "layouts", "--links")
    assert text.status == 0
    assert "667" in text.out
    assert "right_hand_thumb_rota_link2" in text.out


def test_layouts_writes_probe_files_and_reads_them_back(run, tmp_path):
    assert run("tactile", "layouts", "--hand", "xhand1", "--out", str(tmp_path)).status == 0
    found = run("tactile", "layouts", "--hand", "xhand1", "--probes", str(tmp_path / "xhand1_low.json"), "--json")
    assert json.loads(found.out)["counts"]["custom"]["hand"] == 90


def test_an_unknown_hand_is_explained(run):
    found = run("tactile", "layouts", "--hand", "xhand")
    assert found.status == 2
    assert "did you mean 'xhand1'" in found.err


def test_check_compares_this_machine_with_closed_forms(run):
    found = run("tactile", "check", "--json")
    assert found.status == 0, found.out
    checks = json.loads(found.out)["checks"]
    assert len(checks) == 9
    assert all(item["passed"] for item in checks)


def test_check_of_a_folder_presses_every_pad_and_draws_every_hand(run, tmp_path):
    for name in ("jaws-slide", "four-bar-tendon"):
        GALLERY[name].write(tmp_path, name)
    found = run("tactile", "check", str(tmp_path), "--out", str(tmp_path / "pictures"), "--json")
    hands = json.loads(found.out)["hands"]
    assert [(hand["name"], len(hand["tips"]), hand["passed"]) for hand in hands] == [
        ("four-bar-tendon", 2, True), ("jaws-slide", 2, True),
    ]  # fmt: skip
    assert len(list((tmp_path / "pictures").glob("*.png"))) == 2
    (tmp_path / "broken.xml").write_text("<mujoco/>")
    found = run("tactile", "check", str(tmp_path / "broken.xml"), "--out", str(tmp_path / "pictures"))
    assert found.status == 1
    assert "no joints" in " ".join(found.out.split())


def test_hands_of_one_name_are_told_apart_by_their_files(run, tmp_path):
    text = GALLERY["jaws-slide"].text
    for place in ("a/hand.xml", "b c/hand.XML", "b c/hand.mjcf"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text(text)
    found = run("tactile", "check", str(tmp_path), "--out", str(tmp_path / "pictures"), "--json")
    files = [str(Path(hand["file"]).relative_to(tmp_path)) for hand in json.loads(found.out)["hands"]]
    assert files == ["a/hand.xml", "b c/hand.XML", "b c/hand.mjcf"]
    assert len(list((tmp_path / "pictures").rglob("*.png"))) == 3


def test_check_fails_where_a_truth_is_missed(run, monkeypatch):
    from robotics_bridge.sensors import checks as _checks

    monkeypatch.setattr(_checks, "CHECKS", {"planted": lambda device: (1.1, 1.0, 0.05)})
    found = run("tactile", "check")
    assert found.status == 1
    assert "OFF" in found.out


def test_a_folder_of_hands_that_is_not_there_is_said(run, tmp_path):
    found = run("tactile", "check", str(tmp_path / "nowhere"))
    assert (found.status, "is no folder or hand file" in found.err) == (2, True)
    found = run("tactile", "check", str(tmp_path))
    assert (found.status, "holds no hand file (" in found.err) == (2, True)
