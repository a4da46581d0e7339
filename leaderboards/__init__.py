"""Result records, the static site of a leaderboard, and reports.

A record is one JSON file per score, named by its content (:mod:`leaderboards.store`), described by the JSON Schema in
``record.schema.json``. :mod:`leaderboards.boards` decides what may be compared with what, :mod:`leaderboards.entries`
folds seeds together, :mod:`leaderboards.ranking` tests which models differ, :mod:`leaderboards.standing` says what a
score is worth and :mod:`leaderboards.conclusions` says it all in sentences. :mod:`leaderboards.figures` draws,
:mod:`leaderboards.site` writes pages and :mod:`leaderboards.report` papers; :mod:`leaderboards.audit` finds stale and
contradicting records, :mod:`leaderboards.changes` compares builds, :mod:`leaderboards.held_out` keeps recordings back.
This package reads records, never models.
"""

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from leaderboards.boards import rank
    from leaderboards.site.build import build_leaderboard
    from leaderboards.site.score_page import write_report
    from leaderboards.store import read_records, write_record

__all__ = ["build_leaderboard", "rank", "read_records", "write_record", "write_report"]

__getattr__, __dir__ = lazy_exports(__name__)
