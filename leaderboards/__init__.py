"""Result records, the static site of a leaderboard, and reports.

A record is one JSON file per score, named by its content (:mod:`leaderboards.store`), described by
the JSON Schema in ``record.schema.json`` (:mod:`leaderboards.schema`). :mod:`leaderboards.ranking`
decides what may be compared with what, :mod:`leaderboards.entries` folds seeds together,
:mod:`leaderboards.site.site` writes the site and :mod:`leaderboards.report.score_report` reports;
:mod:`leaderboards.audit` finds stale and contradicting records, :mod:`leaderboards.changes` compares
records and builds. This package reads records, never models: scoring is the command line's business.
"""

from leaderboards.ranking import Board, RankedRecord, rank
from leaderboards.report.score_report import write_report
from leaderboards.site.site import build_leaderboard
from leaderboards.store import StoredRecord, read_record, read_records, record_name, write_record

__all__ = [
    "Board",
    "RankedRecord",
    "StoredRecord",
    "build_leaderboard",
    "rank",
    "read_record",
    "read_records",
    "record_name",
    "write_record",
    "write_report",
]
