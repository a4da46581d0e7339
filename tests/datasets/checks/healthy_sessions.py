"""A session without faults, and what the checks say of changed ones."""

from dataclasses import replace

import numpy as np

from brainbench.datasets import check, write_recordings
from brainbench.datasets.sessions import SPIKES, Session, SessionTable, ragged
from brainbench.datasets.synthetic import ResponseGeometry
from tests.factories.recordings import make_sessions, quiet_design

GEOMETRY = ResponseGeometry.from_features(np.random.default_rng(0).normal(size=(6, 4)))


def make_healthy(**design):
    (session,) = make_sessions(GEOMETRY, quiet_design(animals=1, units=20, trials=15, **design))
    return session


def with_spikes(session, change):
    """The session with ``change`` applied to its list of spike times."""
    units = dict(session.units.data)
    spikes = change(np.split(units[SPIKES], units[f"{SPIKES}_index"][:-1]))
    number = len(spikes)
    units = {"id": np.arange(number), **ragged(SPIKES, spikes)}
    units |= ragged("obs_intervals", [np.array([[0.0, session.tables["trials"].data["stop_time"][-1]]])] * number)
    return replace(session, units=SessionTable("units", units))


def findings_of(path, name, severity=None, **options):
    """Findings of one check, with their messages as one text."""
    checkup = check(path, **options)
    items = [item for item in checkup.findings if item.check == name and severity in (None, item.severity)]
    return items, " | ".join(item.message for item in items)


def examine(tmp_path, session: Session, name, severity=None, **options):
    return findings_of(write_recordings(tmp_path / "a.h5", session), name, severity, **options)
