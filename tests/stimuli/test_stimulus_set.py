"""Stimulus sets, and those that the package ships.

``python -m tests.stimuli.test_stimulus_set`` simulates the latter again, to be done whenever ``PHYSICS_VERSION`` is
raised or the scenes of their recipes change; ``python -m tests.stimuli.test_stimulus_set errors`` only their errors.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, read_json, to_json, write_json, write_text
from brainbench.core.reading.sealed import is_sealed, seal_file
from brainbench.stimuli import get_recipe, load_stimuli, simulation, stimulus_set
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import cache_path, simulate, simulate_uncached
from brainbench.stimuli.stimulus_set import (
    SHIPPED,
    SHIPPED_INDEX,
    error_file,
    find_kept,
    hash_stimulus_set,
    read_stimulus_set,
    shipped_facts,
    to_grid,
    write_stimulus_set,
)
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

RECIPES = ("objects", "rodgers")
"""Stimuli of the demo recordings, and of whatever names none."""
FIDELITY = Fidelity.of("balanced,twist=false")
"""The default, as scenes without twist resolve it."""


def entry_name(recipe: str) -> str:
    """Return the name of the cache's entry for a recipe with default options."""
    return cache_path(get_recipe(recipe).scenes, FIDELITY, get_engine("rod")).name


def simulate_again(recipe: str, *, errors: bool = False) -> xr.Dataset:
    """Return the set of a recipe, simulated now."""
    return simulate_uncached(get_recipe(recipe).scenes, FIDELITY, get_engine("rod", errors=errors))


def _dataset(whiskers="all", side="right", count=110, unstable=None):
    scenes = [
        Scene(label, WhiskerArray.mouse(side=side, whiskers=whiskers), frames=Frames(count=count)) for label in "ab"
    ]
    return simulate(scenes, fidelity=Fidelity(), backend=FakeEngine(unstable))


def test_a_hundred_and_ten_frames_become_twenty_two_steps_of_thirty_channels():
    dataset = _dataset()
    grid = to_grid(dataset)
    assert grid.shape == (2, 22, 30, 5, 7)
    assert grid.dtype == np.float32


def test_a_new_set_loads_no_dask():
    code = "import sys; from tests.stimuli import test_stimulus_set as sets; sets._dataset('C2', count=5)\n"
    subprocess.run([sys.executable, "-c", code + "assert 'dask.array' not in sys.modules"], check=True)


def test_a_written_set_keeps_texts_with_letters_of_any_language(tmp_path: Path):
    dataset = _dataset("C2").isel(stimulus=[0]).assign_coords(stimulus=np.array(["köşe, 触覚"], dtype=object))
    dataset["remark"][0, 0] = "10 µs"
    dataset.attrs["content_hash"] = hash_stimulus_set(dataset)
    kept = read_stimulus_set(write_stimulus_set(dataset, tmp_path / "set.h5"))
    assert (kept["stimulus"].item(), kept["remark"].item()) == ("köşe, 触覚", "10 µs")


def test_frame_channel_and_whisker_find_their_place():
    dataset = _dataset()
    grid = to_grid(dataset)
    rng = np.random.default_rng(0)
    for _ in range(50):
        k, frame, w, c = rng.integers([2, 110, 30, 6])
        row, col = int(dataset["row"][w]), int(dataset["col"][w])
        step, substep = divmod(int(frame), 5)
        assert grid[k, step, substep * 6 + c, row, col] == dataset["wrench"].values[k, frame, w, c]


def test_cells_without_a_whisker_are_zero():
    grid = to_grid(_dataset()).reshape(2, 22, 30, 35)
    assert (grid[..., [5, 6, 12, 13, 34]] == 0).all()
    assert (np.abs(grid).max(axis=(0, 1, 2))[[0, 14, 28]] > 0).all()


def test_whiskers_that_were_not_simulated_are_zero_and_the_others_as_in_the_full_set():
    full, few = to_grid(_dataset()), to_grid(_dataset("C0-C3"))
    np.testing.assert_array_equal(few[..., 2, :4], full[..., 2, :4])
    few[..., 2, :4] = 0
    assert (few == 0).all()


def test_other_sub_steps_divide_time_otherwise():
    assert to_grid(_dataset(), substeps=1).shape == (2, 110, 6, 5, 7)
    with pytest.raises(UsageError, match=r"110 frames .*4 sub-steps"):
        to_grid(_dataset(), substeps=4)


def test_both_sides_do_not_fit_one_grid():
    with pytest.raises(UsageError, match=r"both sides.*one side"):
        to_grid(_dataset(side="both", whiskers="C2"))


def test_an_unstable_whisker_is_refused_unless_zero_is_asked_for():
    dataset = _dataset("C1,C2", unstable={0: "blew up"})
    with pytest.raises(DataError, match=r"'C1 in a'.*blew up.*--whiskers.*unstable='zero'"):
        to_grid(dataset)
    grid = to_grid(dataset, unstable="zero")
    assert np.isfinite(grid).all()
    assert (grid[0, -1, :, 2, 1] == 0).all()


@pytest.mark.parametrize("name", ["fidelity", "note"])
def test_attributes_that_are_no_text_are_refused_in_one_sentence(tmp_path, name):
    path = write_stimulus_set(_dataset(), tmp_path / "set.h5")
    with h5py.File(path, "r+") as file:
        file.attrs.create(name, b"\xff\xfe", dtype=h5py.string_dtype())
    with pytest.raises(DataError, match=r"set\.h5"):
        read_stimulus_set(path)


def test_columns_that_are_not_one_per_whisker_are_refused_in_one_sentence():
    dataset = _dataset()
    longer = dataset.drop_vars("col").assign_coords(col=("column", np.resize(dataset["col"].values, 2 * 30)))
    with pytest.raises(DataError, match="'col'"):
        to_grid(longer)


ADVICE = "The package's stimuli are not those of its recipes: run 'python -m tests.stimuli.test_stimulus_set'."


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
    monkeypatch.setattr(stimulus_set, "PHYSICS_VERSION", 0)
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
    monkeypatch.setattr(stimulus_set, "SHIPPED", damaged)
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


def write_errors() -> None:
    """Write the errors of the sets beside them."""
    for recipe in RECIPES:
        dataset = simulate_again(recipe, errors=True)
        values = {name: np.char.mod("%.3g", dataset[name].values).astype(float) for name in ("error", "damping")}
        assert np.isfinite(values["error"]).all()
        write_text(error_file(SHIPPED / entry_name(recipe)), to_json(values, indent=None) + "\n")


def write() -> None:
    SHIPPED.mkdir(exist_ok=True)
    for old in SHIPPED.iterdir():
        old.unlink()
    index = {}
    for recipe in RECIPES:
        dataset, path = simulate_again(recipe), SHIPPED / entry_name(recipe)
        small = {name: {"zlib": True, "complevel": 9} for name, held in dataset.items() if held.dtype.kind in "fb"}
        with atomic_path(path) as temporary:
            dataset.to_netcdf(temporary, engine="h5netcdf", encoding=small)
        seal_file(path)
        index[recipe] = {"entry": path.name, **shipped_facts(recipe)}
    write_json(SHIPPED_INDEX, index)
    write_errors()


if __name__ == "__main__":
    write_errors() if sys.argv[1:] == ["errors"] else write()
