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


def test_a_cache_that_cannot_be_made_is_one_sentence(run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path / "file" / "cache"))
    outcome = run("score", "pixels", "--out", str(tmp_path / "out"))
    assert outcome.status != 0
    assert "Traceback" not in outcome.err
