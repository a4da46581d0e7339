import threading

from brainbench.cli import output


def _set_clock(monkeypatch, *times: float) -> None:
    now = iter(times)
    monkeypatch.setattr(output.clock, "monotonic", lambda: next(now))


def test_a_job_without_steps_says_after_two_seconds_what_it_does(monkeypatch, capsys):
    _set_clock(monkeypatch, 0.0, 1.0, 3.0, 4.0)
    lines = output.ProgressLines("writing")
    for _ in range(3):
        lines.tell()
    assert capsys.readouterr().err == "brainbench: writing (3 s)\n"


def test_a_long_step_is_told_again_until_the_job_is_done(monkeypatch, capsys):
    _set_clock(monkeypatch, 0.0, 1.0, 13.0)
    lines, done = output.ProgressLines(), threading.Event()
    lines.update(1, 5, "scoring")
    waits = iter([False, True])
    monkeypatch.setattr(done, "wait", lambda seconds: next(waits))
    lines.tell_until(done)
    assert capsys.readouterr().err == "brainbench: scoring, 1 of 5 (13 s)\n"


def test_off_a_terminal_progress_is_a_line_at_times(monkeypatch, capsys):
    _set_clock(monkeypatch, 0.0, 1.0, 3.0, 4.0, 14.0)
    # The lines between steps are tested above.
    monkeypatch.setattr(output.ProgressLines, "tell_until", lambda self, done: None)
    with output.progress_bar() as progress:
        for done in range(1, 5):
            progress(done, 4, "simulating")
    # Nothing within the first two seconds, then a line, then none for ten.
    assert [line.split(" (")[0] for line in capsys.readouterr().err.splitlines()] == [
        "brainbench: simulating, 2 of 4",
        "brainbench: simulating, 4 of 4",
    ]
