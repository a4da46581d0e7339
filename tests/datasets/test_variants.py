"""The same recordings in the forms in which laboratories write files: what comes out of each, in one table.

``python -m tests.datasets.test_variants FOLDER`` writes all of them into a folder and prints the table. If the folder
is there, its files are only read, so that another version of the package can be asked for its verdicts on them.
"""

from __future__ import annotations

import re
import sys
import unicodedata
from pathlib import Path

import h5py
import numpy as np
import pytest

from brainbench.core.errors import BrainbenchError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session

NAMES = np.array(["ball", "comb", "disk"])
TRIALS = "intervals/trials"


def animal(number, labels=NAMES, change=None):
    """Twelve trials of half a second, four units of about 6 Hz."""
    random = np.random.default_rng(number)
    start = 2 + np.cumsum(random.uniform(1.2, 1.6, 12))
    spikes = [np.sort(np.append(random.uniform(1, start[-1] + 2, 120), [0.5, start[-1] + 3])) for _ in range(4)]
    table = {"start_time": start, "stop_time": start + 0.5, "stimulus": np.asarray(labels)[np.arange(12) % 3]}
    return make_session(f"m{number}", "1", [change(times) for times in spikes] if change else spikes, {"trials": table})


def put(file, place, values, kind=None, **attributes):
    kind = kind or (file[place].attrs["neurodata_type"] if place in file else "VectorData")
    if place in file:
        del file[place]
    values = np.asarray(values)
    text = values.dtype.kind == "U"
    made = file.create_dataset(
        place, data=values.astype(object) if text else values, dtype=h5py.string_dtype() if text else None
    )
    made.attrs.update({"neurodata_type": kind, **attributes})


def shaped(place, turn):
    return lambda file: put(file, place, turn(file[place][...]))


def linked(place):
    def edit(file):
        if "obs_intervals" in place:
            spans(file)
        if place in file:
            del file[place]
        file[place] = h5py.ExternalLink("elsewhere.h5", f"/{place}")

    return edit


def moved(place, target):
    return lambda file: file.move(place, target)


def spans(file, turn=lambda values: values, index=True):
    put(file, "units/obs_intervals", turn(np.tile([[0.0, 1e3]], (4, 1))))
    if index:
        put(file, "units/obs_intervals_index", np.arange(1, 5), "VectorIndex")


def as_events(file):
    begin, stop, labels = (file[f"{TRIALS}/{name}"][...] for name in ("start_time", "stop_time", "stimulus"))
    del file[TRIALS]
    group = file.create_group("events/trials")
    group.attrs.update({"neurodata_type": "EventsTable", "colnames": ["timestamp", "duration", "stimulus"]})
    put(file, "events/trials/timestamp", begin)
    put(file, "events/trials/duration", stop - begin)
    file["events/trials/stimulus"] = labels


def second_units(file):
    file.copy("units", "processing/one/units")
    file.move("units", "processing/two/units")


def more_units(file):
    file.copy("units", "processing/one/units")


def linked_units(file):
    file["processing/one/units"] = h5py.SoftLink("/units")


def packed(code):
    def edit(file):
        values = file["units/spike_times"][...]
        del file["units/spike_times"]
        create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        create.set_chunk((len(values),))
        create.set_filter(code, h5py.h5z.FLAG_OPTIONAL, (2, 2, 8, 8 * len(values)))
        space = h5py.h5s.create_simple(values.shape)
        made = h5py.h5d.create(file["units"].id, b"spike_times", h5py.h5t.IEEE_F64LE, space, create)
        made.write_direct_chunk((0,), values.tobytes(), 0)

    return edit


SHAPES = {"n1": lambda values: values[:, None], "1n": lambda values: values[None]}
SHAPES |= {"n11": lambda values: values[:, None, None]}
SHAPED = [f"{TRIALS}/{name}" for name in ("start_time", "stop_time", "stimulus", "id")]
SHAPED += [f"units/{name}" for name in ("spike_times", "spike_times_index", "id")]
PLACES = (
    "processing/behavior",
    "stimulus/presentation",
    "analysis",
    "scratch",
    "acquisition",
    "processing/a/b",
    "general",
)
NEEDED = [f"{TRIALS}/stimulus", f"{TRIALS}/start_time", f"{TRIALS}/id", TRIALS, "units", "intervals/invalid_times"]
NEEDED += ["units/spike_times", "units/spike_times_index", "units/obs_intervals", "units/obs_intervals_index"]
UNNEEDED = ("units/electrodes", "acquisition/raw", "general/extracellular_ephys", "units/waveform_mean")


def number_beside(file):
    put(file, f"{TRIALS}/stimulus_index", np.arange(12) % 3)
    put(file, "units/quality", np.ones(4))
    put(file, "units/quality_index", np.arange(4))


def index_of_any_name(file):
    put(file, f"{TRIALS}/tags", np.arange(24))
    put(file, f"{TRIALS}/ends", 2 * np.arange(1, 13), "VectorIndex", target=file[f"{TRIALS}/tags"].ref)


def fixed_text(file):
    del file[f"{TRIALS}/stimulus"]
    file[f"{TRIALS}/stimulus"] = NAMES[np.arange(12) % 3].astype("S")


def template(file):
    file["identifier"][()] = "template"


def elements(*numbers):
    def edit(file):
        put(file, f"{TRIALS}/stimulus", np.array([2, 0, 1, *numbers])[np.arange(12) % (3 + len(numbers))], "EnumData")
        put(file, f"{TRIALS}/stimulus_elements", NAMES[[1, 2, 0]])

    return edit


def rows_of_a_table(file):
    put(file, "general/tools/name", NAMES)
    put(file, f"{TRIALS}/stimulus", np.arange(12) % 3, "DynamicTableRegion", table=file["general/tools"].ref)


def invalid(start, stop):
    def edit(file):
        for name, value in {"id": 0, "start_time": start, "stop_time": stop}.items():
            put(file, f"intervals/invalid_times/{name}", np.array([value]))
        file["intervals/invalid_times"].attrs["neurodata_type"] = "TimeIntervals"

    return edit


def trials_twice(file):
    file.copy(TRIALS, "trials")
    put(file, "trials/start_time", file["trials/start_time"][...] + 0.3)


def unit_twice(file):
    times, ends = file["units/spike_times"][...], file["units/spike_times_index"][...]
    put(file, "units/spike_times", np.append(times, times[: ends[0]]))
    put(file, "units/spike_times_index", np.append(ends, ends[-1] + ends[0]))
    put(file, "units/id", np.arange(5))


def spikes_twice(file):
    put(file, "units/spike_times", np.repeat(file["units/spike_times"][...], 2))
    put(file, "units/spike_times_index", 2 * file["units/spike_times_index"][...])


FILE = {
    "plain": (lambda file: None, "same"),
    **{f"{place} {form}": (shaped(place, turn), "same") for place in SHAPED for form, turn in SHAPES.items()},
    "spans": (spans, "same"),
    "spans 2n": (lambda file: spans(file, np.transpose), "same"),
    "index without spans": (lambda file: (spans(file), file.pop("units/obs_intervals")), r"without obs_intervals;"),
    "trials at the root": (lambda file: file.move(TRIALS, "trials"), "same"),
    "spans without index": (lambda file: spans(file, index=False), r"obs_intervals without obs_intervals_index"),
    "number beside": (number_beside, "same"),
    "index of any name": (index_of_any_name, "same"),
    "big-endian": (shaped(f"{TRIALS}/start_time", lambda values: values.astype(">f8")), "same"),
    "fixed text": (fixed_text, "same"),
    "short index": (shaped("units/spike_times_index", lambda values: values.astype(np.uint16)), "same"),
    "units in ecephys": (moved("units", "processing/ecephys/units"), "same"),
    "units by type": (moved("units", "processing/ecephys/sorted"), "same"),
    "two tables of units": (second_units, r"2 tables of units.*processing/one/units"),
    "units beside the usual ones": (more_units, r"1 of 3 tables: processing/one/units has units that are not read"),
    "units twice by a link": (linked_units, "same"),
    **{f"trials in {place}": (moved(TRIALS, f"{place}/trials"), "same") for place in PLACES},
    "events": (as_events, "same"),
    **{f"dead {place}": (linked(place), r"elsewhere\.h5") for place in NEEDED},
    **{f"dead {place}, not needed": (linked(place), "same") for place in UNNEEDED},
    **{f"filter {code}": (packed(code), rf"filter {code}.*hdf5plugin") for code in (32001, 32004, 32013, 32015)},
    "template identifier": (template, "same"),
    "elements": (elements(), "same"),
    "element of no name": (elements(-1), r"has the number -1 of no element"),
    "rows of a table": (rows_of_a_table, r"holds rows of another table"),
    "float32 times": (shaped(f"{TRIALS}/start_time", lambda values: values.astype("f4").astype("f8")), "same"),
    "float16 times": (shaped(f"{TRIALS}/start_time", lambda values: values.astype("f2")), r"in steps of 0\.\d+ s"),
    "float32 times of Unix": (
        shaped(f"{TRIALS}/start_time", lambda values: (values + 1.7e9).astype("f4")),
        r"in steps of 1\.3e\+02 s",
    ),
    "invalid backwards": (invalid(20.0, 3.0), r"end before they begin"),
    "invalid at no time": (invalid(20.0, np.nan), r"end before they begin, or at no time"),
    "invalid later": (invalid(900.0, 990.0), "same"),
    "two tables of trials": (trials_twice, "same"),
    "a unit twice": (unit_twice, r"1 of 5 units have all spikes of another one"),
    "spikes twice": (spikes_twice, r"spikes stand twice in their unit"),
}
LABELS = {
    "float32": (np.array([0.1, 0.2, 0.3], np.float32), "count as one"),
    "products": (np.arange(1, 4) * 0.1, "count as one"),
    "texts": (np.array(["0.1", "0.20", "0.3"]), "count as one"),
    "nearly": (np.array([0.1, 0.2, 0.3000001]), "count as different stimuli"),
    "NFD": (np.array([unicodedata.normalize("NFD", "\u00e9"), "b", "c"]), "count as one"),
    "blanks": (np.array(["\u00e9 ", "b", "c"]), "count as one"),
    "case": (np.array(["\u00e9", "B", "c"]), "count as different stimuli"),
    **{word: (np.array(["a", "b", word]), "no value of stimulus") for word in ("nan", "NaN", "-nan", "NaT", "")},
    **{
        word: (np.array(["a", "b", word]), "may mean a missing value")
        for word in ("None", "NA", "n/a", "<NA>", "#N/A", "--", "unknown", "\u2014")
    },
}
TIMES = {
    "milliseconds": (lambda times: 1000 * times, "look like milliseconds"),
    "milliseconds early": (lambda times: np.sort(1000 * np.append(1e-6, times)), "look like milliseconds"),
    "microseconds": (lambda times: 1e6 * times, "look like microseconds"),
    "samples": (lambda times: np.round(30000 * times), "look like samples"),
    "restart": (lambda times: np.concatenate([times[:60], times[:60]]), "start anew"),
    "of trials": (lambda times: np.concatenate([np.linspace(0, 0.4, 12)] * 10), "start anew"),
    "of trials, sorted": (lambda times: np.sort(times % 0.5), "count from the start of each trial"),
    "minutes": (lambda times: 60 * times + 1200, "not on one clock"),
    "unsorted": (np.random.default_rng(0).permutation, "have been sorted"),
}


def outcome(folder):
    """Return the data set, and everything that was said of it; or the words of the refusal."""
    try:
        opened = open_recordings(folder, conditions="trials:stimulus")
    except BrainbenchError as error:
        return None, str(error)
    from brainbench.datasets.ledger import balance_line

    return opened, "; ".join([*opened.attrs["doubts"], balance_line(opened.attrs["ledger"])])


def write_variant(folder, name):
    """Write two animals as a variant has them; return what is expected of it."""
    from brainbench.datasets.nwb import write_nwb

    if name in TIMES:
        write_recordings(folder / "m1.h5", animal(1, change=TIMES[name][0]))
        return TIMES[name][1]
    if name in LABELS:
        values, expected = LABELS[name]
        clean = ["\u00e9", "b", "c"] if expected.startswith("count") else ["a", "b", "c"]
        clean = [0.1, 0.2, 0.3] if name in ("float32", "products", "texts", "nearly") else clean
        for number, labels in ((1, clean), (2, values)):
            write_nwb(folder / f"m{number}.nwb", animal(number, labels))
        return expected
    edit, expected = FILE[name]
    for number in (1, 2):
        path = write_nwb(folder / f"m{number}.nwb", animal(number))
        if number == 2 or expected == "same":
            with h5py.File(path, "a") as file:
                edit(file)
    return expected


def verdict(folder, plain):
    """Return in words what comes out of a folder, beside the counts of the plain form."""
    try:
        opened = open_recordings(folder, conditions="trials:stimulus")
    except (BrainbenchError, ArithmeticError, LookupError, OSError, TypeError, ValueError) as error:
        return f"refused: {error}"
    same = opened["counts"].shape == plain.shape and np.array_equal(opened["counts"], plain, equal_nan=True)
    left_out = (entry for kind in opened.attrs.get("ledger", {}).values() for entry in kind["left_out"])
    reasons = {
        entry["reason"]: None for entry in left_out if entry["reason"] not in ("between the windows", "not asked for")
    }
    words = "; ".join([*opened.attrs.get("doubts", ()), *(reasons or opened.attrs.get("skipped", ()))])
    count = f"{opened.sizes['trial']} trials of {len(opened.attrs['vocabulary'])} labels"
    return ("same counts" if same else f"other counts, {count}") + (f", and it says: {words}" if words else "")


def print_table(folder):
    """Print what comes out of every variant, one a line."""
    names = [*FILE, *LABELS, *TIMES]
    for number, name in enumerate(() if folder.exists() else names):
        write_variant(folder / f"{number:02d}", name)
    plain = open_recordings(folder / "00", conditions="trials:stimulus")["counts"].values
    for number, name in enumerate(names):
        words = verdict(folder / f"{number:02d}", plain).replace(f"{folder}/", "")
        sys.stdout.write(f"| {name} | {' '.join(words.split())} |\n")


def test_there_are_at_least_sixty_variants():
    assert len(FILE) + len(LABELS) + len(TIMES) >= 60


@pytest.mark.parametrize("name", FILE)
def test_a_file_in_another_form_gives_the_same_or_names_the_part(tmp_path, name):
    write_variant(tmp_path / "plain", "plain")
    expected = write_variant(tmp_path / "variant", name)
    plain, _ = outcome(tmp_path / "plain")
    variant, words = outcome(tmp_path / "variant")
    if expected == "same":
        assert variant is not None, words
        np.testing.assert_array_equal(variant["counts"], plain["counts"])
        assert variant["stimulus"].values.tolist() == plain["stimulus"].values.tolist()
    else:
        assert re.search(expected, words), words
    assert "balance does not close" not in words


@pytest.mark.parametrize("name", LABELS)
def test_labels_in_another_form_are_merged_or_said(tmp_path, name):
    expected = write_variant(tmp_path, name)
    opened, words = outcome(tmp_path)
    assert expected in words
    assert len(opened.attrs["vocabulary"]) == 3 + ("different" in expected or "mean" in expected)


@pytest.mark.parametrize("name", TIMES)
def test_times_that_are_no_seconds_of_the_session_are_told(tmp_path, name):
    expected = write_variant(tmp_path, name)
    assert expected in outcome(tmp_path)[1]


if __name__ == "__main__":
    print_table(Path(sys.argv[1]))
