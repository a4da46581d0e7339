import multiprocessing

import pytest

from brainbench.core.errors import DataError
from brainbench.core.files import file_hash
from brainbench.core.reading import hdf5
from brainbench.datasets import open_recordings
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, write_files
from brainbench.datasets.synthetic.populations import TRUTH, ensure_recordings

GEOMETRY = ResponseGeometry.from_features([[1.0, 2, 0], [2, 0, 1], [0, 1, 3]], ["a", "b", "c"])


def make(folder):
    write_files(folder, GEOMETRY, PopulationDesign(animals=2, units=5, trials=4))


def ensure():
    return ensure_recordings("small", 1, "key", make=make)


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    return tmp_path / "recordings"


def test_recordings_are_made_once(cache):
    made = ensure()
    stamp = made.stat().st_mtime_ns
    assert ensure_recordings("small", 1, "key", make=lambda _: pytest.fail("not needed")) == made
    assert made.stat().st_mtime_ns == stamp
    assert [item.name for item in cache.iterdir()] == [made.name]
    assert ensure_recordings("small", 2, "key", make=make) != made


def test_a_damaged_folder_is_made_again(caplog):
    made = ensure()
    file = next(made.glob("*.nwb"))
    before = file_hash(file)
    file.write_bytes(b"")
    assert ensure() == made
    assert file_hash(file) == before
    assert "damaged" in caplog.text
    (made / TRUTH).unlink()
    ensure()
    assert (made / TRUTH).exists()


def test_what_a_killed_process_left_is_completed():
    made = ensure()
    (made / TRUTH).unlink()
    sorted(made.glob("*.nwb"))[1].unlink()
    assert ensure() == made
    assert len(open_recordings(made).attrs["sessions"]) == 2


def _ensure(queue):
    queue.put(str(ensure()))


def test_two_processes_may_make_them_at_once(cache):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    workers = [context.Process(target=_ensure, args=(queue,)) for _ in range(2)]
    for worker in workers:
        worker.start()
    paths = {queue.get(timeout=60) for _ in workers}
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert len(paths) == 1
    assert open_recordings(paths.pop()).attrs["synthetic"] is True
    assert not list(cache.glob("*/.*"))


def test_no_folder_is_left_after_a_failure(cache):
    def fail(_):
        raise DataError("no stimuli")

    with pytest.raises(DataError):
        ensure_recordings("small", 1, make=fail)
    assert list(cache.iterdir()) == []


def test_files_whose_hash_was_just_checked_are_opened_at_once(monkeypatch):
    ensure()
    made = ensure()
    monkeypatch.setattr(hdf5, "call_apart", lambda *_: pytest.fail("was looked through by another process"))
    assert open_recordings(made).sizes["trial"] > 0
