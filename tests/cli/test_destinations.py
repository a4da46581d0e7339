from importlib.util import find_spec

import pytest


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (("--out", "file/inside"), "file"),
        (("--report", "x.txt2"), "txt2"),
        (("--report", "none"), "'none'"),
        (("--report", "file/x.md"), "file"),
        (("--report", "."), "report"),
    ],
)
def test_score_refuses_what_it_cannot_write_before_anything_is_loaded(run, tmp_path, monkeypatch, options, culprit):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    # The model does not exist either: that is found later.
    outcome = run("score", "no-such-model", *options)
    assert outcome.status == 2
    assert culprit in outcome.err
    assert "no-such-model" not in outcome.err
    assert outcome.out == ""


@pytest.mark.skipif(find_spec("weasyprint") is not None, reason="weasyprint is installed")
def test_a_pdf_without_its_engine_is_refused_at_once(run):
    assert "weasyprint" in run("score", "no-such-model", "--report", "x.pdf").err


@pytest.mark.parametrize("command", [("train", "zhuang-small", "--data", "none"), ("stimuli", "simulate", "rodgers")])
def test_other_commands_refuse_such_an_out_too(run, tmp_path, command):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, "--out", str(tmp_path / "file" / "a"))
    assert (outcome.status, "--out" in outcome.err) == (2, True)


@pytest.mark.parametrize(
    ("command", "option"),
    [
        (("tradeoff", "whisker"), "--csv"),
        (("tradeoff", "tactile"), "--plot"),
        (("policy", "play", "in_palm_rotate"), "--video"),
        (("policy", "sweep"), "--out"),
        (("policy", "export", "none"), "--out"),
        (("leaderboard", "add", "none"), "--to"),
        (("leaderboard", "hold-out", "demo"), "--secret"),
        (("stimuli", "objects", "torus"), "--export"),
    ],
)
def test_every_option_that_names_a_destination_is_checked_first(run, tmp_path, command, option):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, option, str(tmp_path / "file" / "a.png"))
    assert (outcome.status, option in outcome.err) == (2, True)


@pytest.mark.parametrize("command", [("stimuli", "convert", "none"), ("recordings", "export", "demo")])
def test_destinations_without_an_option_are_checked_first(run, tmp_path, command):
    (tmp_path / "file").write_text("x")
    outcome = run(*command, str(tmp_path / "file" / "a"))
    assert (outcome.status, str(tmp_path / "file") in outcome.err) == (2, True)


@pytest.mark.parametrize("command", [("tradeoff", "tactile", "--plot")])
def test_a_picture_of_an_unknown_format_is_refused_first(run, tmp_path, command):
    outcome = run(*command, str(tmp_path / "x.txt2"))
    assert (outcome.status, "txt2" in outcome.err) == (2, True)


def test_a_cache_that_cannot_be_made_is_one_sentence(run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "file" / "cache"))
    outcome = run("score", "pixels", "--out", str(tmp_path / "out"))
    assert outcome.status != 0
    assert "Traceback" not in outcome.err
