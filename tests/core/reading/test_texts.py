import json

import pytest

from brainbench.core.errors import DataError
from brainbench.core.reading.texts import parse_json, parse_toml, read_mapping


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{"a": [1, {"b": NaN}]}', r"a\[1\]\.b"),
        ('{"a": 1e400}', "'a'.* inf"),
        ('{"a": 99999999999999999999}', r"'a'.*2\^63"),
        (f'{{"a": {"9" * 5000}}}', "file"),
        ("[" * 70 + "]" * 70, "64 levels"),
        ("[" * 100_000, "deep"),
        ('{"a": ["\\ud800"]}', r"a\[0\]"),
        ('{"\\udfff": 1}', "file"),
        ('[{"a": {"b": 1, "c": 2, "b": 1}}]', "'b' twice"),
    ],
)
def test_json_is_bounded_in_digits_depth_and_range(text, told):
    with pytest.raises(DataError, match=told):
        parse_json(text, "file")


@pytest.mark.parametrize("text", ["a = nan", "a = inf", "a = 99999999999999999999", "x = " + "[" * 5000, "a = "])
def test_toml_is_bounded_too(text):
    with pytest.raises(DataError, match="file"):
        parse_toml(text, "file")


def test_plain_values_pass_unchanged():
    value = {"a": [1, 2.5, None, True, "NaN"], "b": {"c": -(2**62)}}
    assert parse_json(json.dumps(value), "file") == value


def test_the_ending_tells_the_language_and_aliases_are_refused(tmp_path):
    pytest.importorskip("yaml")
    for name, text in (("a.json", '{"a": {"b": 1}}'), ("a.toml", "a.b = 1"), ("a.yaml", "a:\n  b: 1\n")):
        (tmp_path / name).write_text(text)
        assert read_mapping(tmp_path / name) == {"a": {"b": 1}}
    laughs = "a: &a [x, x]\n" + "".join(f"b{i}: &b{i} [*a, *a]\n" for i in range(3))
    for text, told in (
        (laughs, "alias"),
        ("a: .nan", "nan"),
        ("x: [{b: 1, c: 2, b: 3}]", "'b' twice"),
        ("a: " + "[" * 50_000, "deep"),
        ("a: [", "YAML"),
    ):
        (tmp_path / "a.yaml").write_text(text)
        with pytest.raises(DataError, match=told):
            read_mapping(tmp_path / "a.yaml")
