import importlib
import logging
import re
import subprocess
import sys
from dataclasses import asdict

import pytest
import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.core.files import read_mapping, write_json
from brainbench.models import registry
from brainbench.models.registry import (
    SIZES,
    describe_model,
    list_models,
    load_model,
    load_user_model,
    locate_model,
    measure,
    register_model,
)
from brainbench.models.training.checkpoints import shipped

SMALL = "zhuang-ugrnn-small"


@pytest.fixture
def _clean(monkeypatch):
    """Keep what a test registers out of the registry of the others."""
    list_models()
    monkeypatch.setattr(registry, "_records", dict(registry._records))


def test_names_follow_the_grammar_and_patterns_select_them():
    names = list_models()
    assert names[0] == "zhuang"
    assert len(names) == len(set(names)) == 78
    assert list_models("zhuang-intersection-ln*") == [
        "zhuang-intersection-ln",
        "zhuang-intersection-ln+gpt",
        "zhuang-intersection-ln+mamba",
        "zhuang-intersection-ln-small",
        "zhuang-intersection-ln-small+gpt",
        "zhuang-intersection-ln-small+mamba",
    ]
    assert list_models("resnet*") == [
        f"resnet18{size}{attender}" for size in ("", "-small") for attender in ("", "+gpt", "+mamba")
    ]
    assert list_models("transformer*") == []


def test_listing_models_imports_no_framework():
    code = "import sys, brainbench; brainbench.list_models(); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("zhuang-intersecton-ln", "Unknown model 'zhuang-intersecton-ln'; did you mean 'zhuang-intersection-ln'?"),
        ("Zhuang-LSTM", "did you mean 'zhuang-lstm'"),
        ("zhuang.supervized", r"did you mean 'supervised'\? Allowed: 'supervised', 'simclr', 'simsiam', 'ae'"),
        ("models/mine.py:make", "looks like a path, not a model's name; .* path/to/file.py:make_model"),
        ("mine.py", "looks like a path"),
        ("runs/best", "a folder of trained weights as local-dir:"),
        ("zhuang+gpt.simclr", r"train them with: brainbench train zhuang\+gpt --objective simclr; or load"),
    ],
)
def test_a_name_without_a_model_is_answered_in_one_sentence(name, message):
    with pytest.raises(UsageError, match=message):
        load_model(name)


def test_equal_seeds_give_equal_weights_and_disturb_nobody():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = load_model(SMALL, seed=3).state_dict()
    assert torch.equal(torch.rand(3), expected)
    torch.rand(100)
    second, third = load_model(SMALL, seed=3).state_dict(), load_model(SMALL, seed=4).state_dict()
    assert all(torch.equal(value, second[name]) for name, value in first.items())
    assert any(not torch.equal(value, third[name]) for name, value in first.items())


@pytest.mark.parametrize("precision", [torch.float64, torch.float16])
def test_defaults_of_the_program_change_no_weights_and_stay(precision, tmp_path):
    target = f"{_file(tmp_path, 'def make_model(): return nn.Linear(3, 4)')}:make_model"
    expected = [*load_model(SMALL, seed=3).parameters(), *load_user_model(target, seed=3).parameters()]
    try:
        torch.set_default_dtype(precision)
        torch.set_default_device("meta")
        network = load_model(SMALL, seed=3)
        torch.set_default_device(None)
        drawn = [*network.parameters(), *load_user_model(target, seed=3).parameters()]
        assert torch.get_default_dtype() == precision
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
    assert all(torch.equal(left, right) for left, right in zip(drawn, expected, strict=True))
    assert {value.dtype for value in drawn} == {torch.float32}


def test_a_precision_that_a_file_of_code_chooses_stays(tmp_path):
    code = "torch.set_default_dtype(torch.float64)\ndef make_model(): return nn.Linear(3, 4)"
    target = f"{_file(tmp_path, code)}:make_model"
    try:
        assert load_user_model(target).weight.dtype == torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "0", 2**63])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(UsageError, match=r"seed .*received"):
        load_model(SMALL, seed=seed)


def test_a_loaded_model_is_ready_for_evaluation():
    assert not any(module.training for module in load_model(SMALL).modules())


def test_weights_are_loaded_under_a_tag_only(tmp_path):
    from safetensors.torch import save_file

    file = tmp_path / "weights.safetensors"
    source = load_model(SMALL, seed=9).state_dict()
    save_file(source, file)
    loaded = load_model(f"{SMALL}.supervised", pretrained=file).state_dict()
    assert all(torch.equal(value, loaded[name]) for name, value in source.items())
    with pytest.raises(UsageError, match=rf"'{SMALL}' .*{SMALL}\.supervised"):
        load_model(SMALL, pretrained=file)
    with pytest.raises(DataError, match=r"'zhuang-gru-small\.simclr'"):
        load_model("zhuang-gru-small.simclr", pretrained=file)
    with pytest.raises(DataFileNotFoundError, match=rf"'{SMALL}\.ae'.*none\.safetensors'"):
        load_model(f"{SMALL}.ae", pretrained=tmp_path / "none.safetensors")
    file.write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"weights\.safetensors' .*safetensors"):
        load_model(f"{SMALL}.ae", pretrained=file)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("zhuang-intersection-ln", 37_988_821),
        ("zhuang-intersection-ln+gpt", 63_767_509),
        ("resnet18+gpt", 18_086_517),
        ("resnet18+mamba", 18_367_861),
        ("s4", 3_434_496 + 60_021),
    ],
)
def test_a_description_states_the_published_size(name, parameters):
    described = describe_model(name)
    assert described.parameters == parameters
    assert described.licence == "MIT"
    assert described.citation.count(";") == name.count("+")
    assert described.source == "brainbench"
    assert described.layers[-1] == "decoder"


@pytest.mark.parametrize(
    "name",
    [
        "zhuang-small",
        "zhuang-gru-ln-small",
        "zhuang-lstm-small+gpt",
        "zhuang-feedforward-small",
        "resnet18-small",
        "resnet18-small+mamba",
    ],
)
def test_multiply_adds_equal_pytorchs_count(name):
    model = load_model(name)
    # PyTorch does not count its fused attention on the CPU; a multiply-add is two FLOPs.
    with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        model.activations(torch.zeros(1, 1, 30, 5, 7))
    assert describe_model(name).multiply_adds == counter.get_total_flops() // 2


def test_multiply_adds_of_state_spaces_are_those_of_a_streamed_step():
    linear = 1050 * 96 + 4 * 96 * 192 + 96 * 96 + 96 * 117
    assert describe_model("s4-small").multiply_adds == linear + 4 * 96 * 32 * 12


def test_the_full_gated_network_costs_what_was_published():
    assert describe_model("zhuang-intersection-ln").multiply_adds == pytest.approx(0.46e9, rel=0.01)


@pytest.mark.usefixtures("_clean")
def test_a_registered_function_becomes_a_model():
    @register_model("tiny+linear", family="linear", licence="MIT")
    def tiny():
        model = nn.Sequential(nn.Flatten(2), nn.Linear(1050, 3))
        model.layers = [model[1]]  # as many networks call their parts: these are no names
        return model

    assert list_models("tiny*") == ["tiny+linear"]
    assert load_model("tiny+linear")(torch.zeros(1, 2, 30, 5, 7)).shape == (1, 2, 3)
    described = describe_model("tiny+linear")
    assert (described.parameters, described.multiply_adds, described.layers) == (3153, None, ())
    with pytest.raises(UsageError, match="'tiny\\+linear' is already"):
        register_model("tiny+linear", family="linear")(tiny)


@pytest.mark.usefixtures("_clean")
def test_a_model_that_computes_while_it_is_built_can_be_described():
    @register_model("computing", family="linear")
    def computing():
        return nn.Linear(int(torch.linspace(1, 7, 3)[-1].item()), 2)

    assert describe_model("computing").parameters == 16


@pytest.mark.usefixtures("_clean")
def test_our_names_are_taken_from_the_start():
    with pytest.raises(UsageError, match="'zhuang' is already"):
        register_model("zhuang", family="mine")(nn.Identity)


@pytest.mark.parametrize("name", ["Zhuang", "a.b", "a b", "a--b", "", "a/b", "+a"])
def test_a_name_outside_the_grammar_is_refused(name):
    with pytest.raises(UsageError, match=re.escape(f"received '{name}'")):
        register_model(name, family="x")


def test_a_record_cannot_be_changed_from_outside():
    record = locate_model("zhuang").record
    assert record is not locate_model("zhuang").record
    assert record == locate_model("zhuang").record
    with pytest.raises(AttributeError):
        record.family = "mine"


@pytest.mark.usefixtures("_clean")
def test_models_of_other_packages_arrive_and_broken_ones_are_announced(tmp_path, monkeypatch, caplog):
    package = tmp_path / "elsewhere.py"
    package.write_text(
        "from torch import nn\n"
        "from brainbench.models.registry import register_model\n"
        "@register_model('elsewhere', family='theirs')\n"
        "def make():\n    return nn.Identity()\n"
    )
    broken = tmp_path / "broken_elsewhere.py"
    broken.write_text("raise RuntimeError('out of order')\n")
    info = tmp_path / "elsewhere-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[brainbench.models]\nmine = elsewhere:make\nbroken = broken_elsewhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(registry, "_loaded", set())
    # The plug-in may be imported before the registry is first asked.
    importlib.import_module("elsewhere")
    with caplog.at_level(logging.WARNING):
        names = list_models()
    assert "elsewhere" in names
    assert "zhuang" in names
    assert "'broken' (broken_elsewhere)" in caplog.text
    assert "out of order" in caplog.text
    assert "mine" not in caplog.text


@pytest.mark.usefixtures("_clean")
@pytest.mark.parametrize("use", [load_model, describe_model])
def test_a_builder_that_gives_no_module_is_answered_in_one_sentence(use):
    register_model("no-module", family="theirs")(lambda: {"weights": 3})
    with pytest.raises(UsageError, match=r"'no-module' .*dict"):
        use("no-module")


def _names_with_sizes():
    """Names of our own models, untrained and trained."""
    return [name for name in list_models() if locate_model(name).record.source == "brainbench"] + list(shipped())


def _size(name):
    """Size of a model as it is measured now, in JSON types."""
    size = asdict(measure(locate_model(name)))
    return {**size, "layers": list(size["layers"])}


def test_every_model_of_ours_has_a_shipped_size():
    assert set(read_mapping(SIZES)) == set(_names_with_sizes())


@pytest.mark.parametrize("name", ["zhuang", "resnet18-small+gpt.simclr", "s4-small+mamba"])
def test_shipped_sizes_are_those_that_are_measured(name):
    assert read_mapping(SIZES)[name] == _size(name), "write them again: python -m tests.models.test_registry"


@pytest.mark.slow
def test_all_shipped_sizes_are_those_that_are_measured():
    assert read_mapping(SIZES) == {name: _size(name) for name in _names_with_sizes()}


def _file(folder, text, name="mine.py"):
    path = folder / name
    path.write_text(f"import torch\nfrom torch import nn\n{text}")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "def make_model():\n    return nn.Linear(3, 4)\n",
        "class make_model(nn.Linear):\n    def __init__(self):\n        super().__init__(3, 4)\n",
        "make_model = nn.Linear(3, 4)\n",
    ],
)
def test_a_function_a_class_or_a_module_is_a_model(tmp_path, text):
    model = load_user_model(f"{_file(tmp_path, text)}:make_model")
    assert isinstance(model, nn.Linear)
    assert not model.training


def test_an_installed_module_is_found_by_its_name():
    assert isinstance(load_user_model("torch.nn:Identity"), nn.Identity)


def test_equal_seeds_give_equal_weights_of_a_users_model_and_disturb_nobody(tmp_path):
    target = f"{_file(tmp_path, 'def make_model(): return nn.Linear(3, 4)')}:make_model"
    torch.manual_seed(1)
    expected = torch.rand(2)
    torch.manual_seed(1)
    first = load_user_model(target, seed=2)
    assert torch.equal(torch.rand(2), expected)
    assert torch.equal(load_user_model(target, seed=2).weight, first.weight)
    assert not torch.equal(load_user_model(target, seed=3).weight, first.weight)


def test_a_file_may_import_its_neighbours_and_leaves_no_path_behind(tmp_path):
    import sys

    (tmp_path / "neighbour_of_mine.py").write_text("WIDTH = 7\n")
    path = _file(tmp_path, "from neighbour_of_mine import WIDTH\ndef make_model(): return nn.Linear(WIDTH, 1)\n")
    before = list(sys.path)
    assert load_user_model(f"{path}:make_model").in_features == 7
    assert sys.path == before


def test_files_of_two_folders_have_neighbours_of_their_own(tmp_path):
    paths = []
    for width in (3, 5):
        folder = tmp_path / str(width)
        (folder / "parts").mkdir(parents=True)
        (folder / "parts" / "__init__.py").write_text(f"WIDTH = {width}\n")
        paths.append(_file(folder, "from parts import WIDTH\ndef make_model(): return nn.Linear(WIDTH, 1)\n"))
    assert [load_user_model(f"{path}:make_model").in_features for path in paths] == [3, 5]


def test_an_edited_neighbour_is_read_again(tmp_path):
    (tmp_path / "edited_neighbour.py").write_text("WIDTH = 7\n")
    path = _file(tmp_path, "from edited_neighbour import WIDTH\ndef make_model(): return nn.Linear(WIDTH, 1)\n")
    assert load_user_model(f"{path}:make_model").in_features == 7
    (tmp_path / "edited_neighbour.py").write_text("WIDTH = 77777\n")
    assert load_user_model(f"{path}:make_model").in_features == 77777


def test_an_edited_file_is_read_again(tmp_path):
    path = _file(tmp_path, "def make_model(): return nn.Linear(2, 1)\n")
    assert load_user_model(f"{path}:make_model").in_features == 2
    path.write_text("from torch import nn\ndef make_model(): return nn.Linear(55555, 1)\n")
    assert load_user_model(f"{path}:make_model").in_features == 55555


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("mke_model", "Unknown model in .*mine.py' 'mke_model'; did you mean 'make_model'"),
        ("number", "gave a int, not a torch.nn.Module"),
        ("needs", "failed with TypeError: .* missing 1 required positional argument: 'width' .* without arguments"),
        ("breaks", "failed with RuntimeError: no weights"),
    ],
)
def test_a_wrong_attribute_is_answered_in_one_sentence(tmp_path, name, message):
    text = (
        "def make_model(): return nn.Identity()\nnumber = 3\ndef needs(width): return nn.Linear(width, 1)\n"
        "def breaks(): raise RuntimeError('no weights')\n"
    )
    with pytest.raises((UsageError, DataError), match=message):
        load_user_model(f"{_file(tmp_path, text)}:{name}")


@pytest.mark.parametrize("target", ["mine.py", "zhuang", ":make_model", "mine.py:"])
def test_a_target_without_both_parts_is_refused(target):
    with pytest.raises(UsageError, match=rf"package\.module:NAME.*'{target}'"):
        load_user_model(target)


def test_a_missing_file_or_module_is_named(tmp_path):
    with pytest.raises(DataFileNotFoundError, match=r"/none\.py'"):
        load_user_model(f"{tmp_path / 'none.py'}:make_model")
    with pytest.raises(DataFileNotFoundError, match="'no_such_package'"):
        load_user_model("no_such_package:make_model")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def make_model(:\n", "failed with SyntaxError"),
        ("import no_such_package\n", "failed: No module named 'no_such_package'"),
        ("1 / 0\n", "failed with ZeroDivisionError"),
    ],
)
def test_a_file_that_cannot_be_imported_says_why(tmp_path, text, message):
    with pytest.raises(DataError, match=message):
        load_user_model(f"{_file(tmp_path, text)}:make_model")


if __name__ == "__main__":
    write_json(SIZES, {name: _size(name) for name in _names_with_sizes()})
