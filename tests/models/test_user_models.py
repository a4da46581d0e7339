import pytest
import torch
from torch import nn

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.models.user_models import load_user_model


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


def test_equal_seeds_give_equal_weights_and_disturb_nobody(tmp_path):
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
