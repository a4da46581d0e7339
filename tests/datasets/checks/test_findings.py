from brainbench.datasets.checks.findings import SEVERITIES, Finding, share, some


def test_severities_are_worst_first():
    findings = [Finding("note", "labels", "a"), Finding("error", "file", "b"), Finding("warning", "clock", "c")]
    worst_first = sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
    assert [finding.message for finding in worst_first] == ["b", "c", "a"]


def test_a_share_of_nothing_is_no_division_by_zero():
    assert share(3, 40) == "3 of 40 (8 %)"
    assert share(0, 0) == "0 of 0 (0 %)"


def test_long_lists_say_how_many_names_are_left():
    assert some(["a", "b"]) == "a, b"
    assert "3" in some(list("abcde"), 2)
