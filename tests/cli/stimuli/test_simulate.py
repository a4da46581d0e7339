import json
from pathlib import Path


def test_simulate_explains_what_it_left_out_and_show_reads_the_file(run, scene, tmp_path):
    file = tmp_path / "set.h5"
    result = run("stimuli", "simulate", scene, "--fidelity", "fast", "--out", str(file), "--explain", "--json")
    assert result.status == 0, result.err
    data = json.loads(result.out)
    # Whiskers at rest are not stepped.
    assert (data["explanation"]["simulated"], data["explanation"]["silent"]) == (2, 2)
    assert data["explanation"]["out_of_reach"] == {"still": [], "whisking": []}
    assert [item["stimulus"] for item in data["stimuli"]] == ["whisking", "still"]
    text = run("stimuli", "simulate", scene, "--fidelity", "fast", "--explain").out
    assert "2 stimuli × 2 whiskers = 4 runs of " in text
    assert "earlier, read from" in text
    shown = run("stimuli", "show", str(file)).out
    assert "simulated by rod" in shown
    assert "whisking" in shown


def test_simulate_writes_whiskers_that_cannot_be_trusted_and_names_them(run, tmp_path):
    import xarray as xr

    scene = str(Path(__file__).parents[3] / "docs" / "scenes" / "inside.toml")
    arguments = ("stimuli", "simulate", scene, "--whiskers", "C1,C4", "--out", str(tmp_path / "a.h5"))
    shown = json.loads(run(*arguments, "--json").out)
    assert [(row["stimulus"], row["whisker"]) for row in shown["unstable"]] == [("inside", "C4")]
    assert "deep in an object" in shown["unstable"][0]["reason"]
    assert "C4" in run(*arguments).out
    with xr.open_dataset(tmp_path / "a.h5", engine="h5netcdf") as dataset:
        assert dataset["status"].values.tolist() == [["ok", "unstable"]]
        assert dataset["wrench"].isnull().any(("time", "channel")).values.tolist() == [[False, True]]
    score = ("score", "zhuang-small", "--stimuli", str(tmp_path / "a.h5"), "--recordings", "demo-rodgers")
    assert run(*score).status != 0
