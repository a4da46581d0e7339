"""Result records, the report of one score and the leaderboard page.

A record is one JSON file per score, named by its content (:mod:`leaderboards.store`), described by
the JSON Schema in ``record.schema.json`` (:mod:`leaderboards.schema`). :mod:`leaderboards.ranking`
decides what may be compared with what, :mod:`leaderboards.report` writes the HTML pages. This
package reads records, never models: scoring again is the command line's business.
"""

from leaderboards.ranking import Board, RankedRecord, rank
from leaderboards.report import build_leaderboard, write_report
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
