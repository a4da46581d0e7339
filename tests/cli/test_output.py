from brainbench.cli import output


def test_off_a_terminal_progress_is_a_line_at_times(monkeypatch, capsys):
    now = iter([0.0, 1.0, 3.0, 4.0, 14.0])
    monkeypatch.setattr(output.clock, "monotonic", lambda: next(now))
    with output.progress_bar() as progress:
        for done in range(1, 5):
            progress(done, 4, "simulating")
    # Nothing within the first two seconds, then a line, then none for ten.
    assert [line.split(" (")[0] for line in capsys.readouterr().err.splitlines()] == [
        "brainbench: simulating, 2 of 4",
        "brainbench: simulating, 4 of 4",
    ]
