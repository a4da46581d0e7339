import json
import math

from brainbench.core.files import to_json
from brainbench.core.provenance import Provenance, UniquePart
from tests.factories.records import make_score


def test_provenance_is_typed_and_keeps_what_it_does_not_know():
    stated = {"version": "0.1.0", "recordings": {"source": "demo"}, "seed": 3, "command": 7, "settings": {}}
    origin = make_score(provenance=stated).provenance
    assert isinstance(origin, Provenance)
    assert (origin.version, origin.recordings["source"]) == ("0.1.0", "demo")
    assert origin.command == ""  # of another kind, so it counts as absent
    assert origin.more == {"seed": 3, "command": 7, "settings": {}}
    assert origin == stated
    assert json.loads(to_json(origin)) == stated


def test_works_to_cite_are_read_as_texts_each_once():
    stated = {"recordings": {"citation": "Doe (2026)"}, "benchmark": {"name": "lab", "citation": "Doe (2026)"}}
    origin = Provenance.of(stated)
    assert (origin.benchmark_name, origin.citations) == ("lab", ["Doe (2026)"])
    data = {"name": "lab", "source": "DANDI:1", "version": "2", "doi": "https://doi.org/10.1/AB"}
    assert Provenance.of(stated | {"benchmark": data}).citations == [
        "Doe (2026)",
        "Recordings of lab, DANDI:1, 2, doi:10.1/AB",
    ]
    layout = {"recordings": {"citation": "Doe (2026), doi:10.1/ab"}, "benchmark": data}
    assert Provenance.of(layout).citations == ["Doe (2026), doi:10.1/ab"]
    # Anyone may write a record.
    assert Provenance.of({"benchmark": {"name": 3, "citation": ["x"]}}).citations == []
    assert Provenance.of({"benchmark": "lab"}).benchmark_name == ""


def test_a_unique_part_is_read_where_numbers_state_it():
    stated = {
        "status": "ok",
        "reasons": [],
        "unique": 0.5,
        "interval": [0.25, 0.75],
        "shared": 0.1,
        "controls": ["raw"],
    }
    part = make_score(provenance={"statistics": {"unique": stated}}).provenance.unique
    assert part is not None
    assert (part.unique, part.low, part.high, part.shared, part.controls) == (0.5, 0.25, 0.75, 0.1, ("raw",))
    assert make_score().provenance.unique is None
    for damaged in ({"unique": "1"}, {"unique": True, "interval": 3}, {"unique": None, "interval": [1], "controls": 4}):
        part = make_score(provenance={"statistics": {"unique": damaged}}).provenance.unique
        assert part is not None
        assert math.isnan(part.unique)
        assert math.isnan(part.low)


def test_a_number_beyond_every_float_is_none():
    part = UniquePart.of({"unique": 10**400, "total": -(10**400), "interval": [10**400, 1], "shared": 1})
    assert math.isnan(part.unique + part.low + part.total)
    assert (part.high, part.shared) == (1, 1)
