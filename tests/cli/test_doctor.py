import json


def test_doctor_says_what_each_missing_part_would_enable(run, monkeypatch):
    from brainbench.cli import doctor

    found = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "pynwb" else found(name))
    result = run("doctor")
    assert result.status == 0
    line = next(line for line in result.out.splitlines() if line.startswith("pynwb"))
    assert "not installed" in line
    assert line.split("not installed")[1].split()[0] == "nwb"
    assert "pip install -c constraints.txt '.[EXTRA]'" in result.out
    data = json.loads(run("doctor", "--json").out)
    assert data["optional"]["pynwb"]["version"] is None
    assert data["required"]["torch"]
    # A package of several extras stands with the one that is about it.
    extras = {"onnx": "export", "tensordict": "policies", "pillow": "report", "scikit-fem": "tactile"}
    assert {name: data["optional"][name]["extra"] for name in extras} == extras


def test_doctor_says_that_the_cache_cannot_be_made(run, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "file" / "cache"))
    result = run("doctor")
    assert result.status == 0
    assert "cannot be made (Not a directory); name a folder" in result.out
    assert "torch" in result.out
    data = json.loads(run("doctor", "--json").out)
    assert (data["cache"], data["cache_bytes"]) == (None, 0)
    assert "BRAINBENCH_CACHE" in data["cache_problem"]


def test_doctor_says_what_each_extra_of_users_enables():
    from brainbench.cli.doctor import ENABLES
    from tests.factories.installations import EXTRAS

    # "rod" has no packages; "peers" are measured by a benchmark alone.
    assert {*ENABLES} == {*EXTRAS} - {"rod", "docs", "test", "dev", "peers"}
