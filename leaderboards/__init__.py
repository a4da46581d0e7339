"""Result records, the static site of a leaderboard, and reports.

A record is one JSON file per score, named by its content and described by the JSON Schema in ``record.schema.json``
(:mod:`leaderboards.store`). :mod:`leaderboards.boards` decides what may be compared with what and says the result in
sentences, :mod:`leaderboards.entries` folds seeds together, and :mod:`leaderboards.ranking` tests which models differ
and says what a score is worth. :mod:`leaderboards.figures` draws, :mod:`leaderboards.site` writes pages and
:mod:`leaderboards.report` papers; :mod:`leaderboards.audit` finds stale and contradicting records and compares builds,
:mod:`leaderboards.held_out` keeps recordings back. This package reads records, never models.
"""

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from leaderboards.boards import rank
    from leaderboards.site.build import build_leaderboard, write_report
    from leaderboards.store import read_records, write_record

__all__ = ["build_leaderboard", "rank", "read_records", "write_record", "write_report"]

__getattr__, __dir__ = lazy_exports(__name__)
