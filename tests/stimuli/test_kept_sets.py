from pathlib import Path

import numpy as np
import pytest

from brainbench.core.files import read_json
from brainbench.core.reading.sealed import is_sealed, seal_file
from brainbench.stimuli import Fidelity, get_recipe, kept_sets, load_stimuli, simulate, simulation
from brainbench.stimuli.kept_sets import SHIPPED, SHIPPED_INDEX, find_kept
from brainbench.stimuli.stimulus_set import read_stimulus_set
from tests.factories.shipped_stimuli import RECIPES, entry_name, simulate_again

ADVICE = "The package's stimuli are not those of its recipes: run 'python -m tests.factories.shipped_stimuli'."


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))


@pytest.fixture
def no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "simulate_uncached", lambda *given, **more: pytest.fail("simulated again"))


def _asked(recipe: str, whiskers: str = "all", fidelity: str | None = None) -> tuple[Path, str] | None:
    return find_kept(recipe, whiskers, Fidelity.of(fidelity), "rod")


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_package_holds_the_set_of_its_own_recipe(recipe: str):
    found = _asked(recipe)
    assert found is not None, ADVICE
    assert found[0] == SHIPPED / entry_name(recipe), ADVICE
    assert is_sealed(found[0])
    dataset = read_stimulus_set(found[0])
    assert dataset["stimulus"].values.tolist() == [scene.label for scene in get_recipe(recipe).scenes], ADVICE
    assert (dataset["status"] == "ok").all()
    assert sum(item.stat().st_size for item in SHIPPED.iterdir()) < 1e6


@pytest.mark.usefixtures("no_simulation")
def test_a_set_of_the_package_is_read_by_name_and_by_scenes_with_an_empty_cache(tmp_path: Path):
    by_name, by_scenes = load_stimuli("rodgers"), simulate(get_recipe("rodgers").scenes)
    assert by_name.content_hash == by_scenes.attrs["content_hash"]
    assert not list(tmp_path.rglob("*.h5"))
    # Whoever scores these stimuli sees how wrong their forces may be.
    error, touched = by_scenes["error"].values, by_scenes["contact"].values.any(axis=1)
    assert np.isfinite(error).all()
    assert 0.05 < np.median(error[touched]) < 0.5
    assert [bool(remark) for remark in by_scenes["remark"].values.flat] == (error.ravel() > 0.1).tolist()
    assert by_name.dataset is not None
    np.testing.assert_array_equal(by_name.dataset["error"], error)


def test_other_options_or_changed_scenes_are_not_the_set_of_the_package(monkeypatch: pytest.MonkeyPatch):
    assert _asked("rodgers", "C1") is None
    assert _asked("rodgers", fidelity="fast") is None
    assert find_kept("rodgers", "all", Fidelity.of(None), "mujoco") is None
    monkeypatch.setattr(kept_sets, "PHYSICS_VERSION", 0)
    assert _asked("rodgers") is None


@pytest.mark.usefixtures("no_simulation")
def test_a_damaged_set_of_the_package_gives_way_to_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    name = read_json(SHIPPED_INDEX)["rodgers"]["entry"]
    damaged, entry = tmp_path / "package", tmp_path / "stimuli" / name
    for folder in (damaged, entry.parent):
        folder.mkdir()
        (folder / name).write_bytes((SHIPPED / name).read_bytes())
        seal_file(folder / name)
    (damaged / name).write_bytes(b"\x89HDF" + bytes(1000))
    monkeypatch.setattr(kept_sets, "SHIPPED", damaged)
    assert simulate(get_recipe("rodgers").scenes).encoding["source"] == str(entry)
    assert "damaged" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_the_set_of_the_package_is_what_its_recipe_gives(recipe: str):
    found, made = load_stimuli(recipe).dataset, simulate_again(recipe)
    assert found is not None
    assert found.attrs["config_hash"] == made.attrs["config_hash"]
    np.testing.assert_array_equal(found["contact"], made["contact"])
    for channels in (slice(0, 3), slice(3, 6)):
        held, now = (item["wrench"].values[..., channels] for item in (found, made))
        # Contact magnifies what single precision rounds otherwise on another processor.
        assert np.abs(held - now).max() <= 5e-3 * np.abs(held).max(), ADVICE
