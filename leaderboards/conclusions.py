"""Conclusions of a board in sentences: who leads, and who is told apart from the leader, raw input and chance."""

from __future__ import annotations

from collections.abc import Sequence

from brainbench.core.errors import listing
from leaderboards.boards import RAW_INPUT, Board
from leaderboards.entries import Entry
from leaderboards.text import number, plural, span


def conclusions(board: Board) -> list[str]:
    """Return one sentence or two per conclusion, the most important first."""
    here = [entry for entry in board.entries if not entry.not_repeatable]
    tested = [entry for entry in here if not entry.unranked_because]
    found = _leader(board, tested)
    if board.truth:
        found.append(_truth(board, tested))
    if tested and any(item.name == RAW_INPUT for item in board.baselines):
        above = [entry for entry in tested if entry.above_raw]
        who = f": {_names(above)}" if above else ""
        found.append(f"Told apart above {RAW_INPUT}: {len(above)} of {plural(len(tested), 'model')}{who}.")
    if chance := sum(entry.standing == "not told apart from chance" for entry in here):
        found.append(f"Not told apart from chance: {chance} of {plural(len(here), 'model')}.")
    if apart := len(board.entries) - len(here):
        found.append(f"Standing apart because nobody here can compute them again: {plural(apart, 'entry', 'entries')}.")
    return found


def _leader(board: Board, tested: Sequence[Entry]) -> list[str]:
    leader = board.leader
    if board.lacks:
        return [f"Models cannot be ranked on this board: ranks need {board.lacks}."]
    if leader is None:
        few = "no score is both reliable and told apart from chance" if tested else "no entry states what ranks need"
        return [f"No model leads this board: {few}."]
    others = [entry for entry in tested if _computation(entry) != _computation(leader)]
    level = [entry for entry in others if not entry.below_leader]
    text = f"Highest score: {leader.name}, {number(leader.scaled)} {span(leader.interval)}".rstrip() + "."
    if not others:
        return [text]
    if not level:
        return [f"{text} It is told apart from the {plural(len(others), 'other model')}."]
    if len(level) == len(others):
        return [f"{text} It is not told apart from any other model."]
    apart = len(others) - len(level)
    return [f"{text} It is told apart from {apart} of {len(others)} others, but not from {_names(level)}."]


def _truth(board: Board, tested: Sequence[Entry]) -> str:
    """Say whether the network that made the recordings is where it must be."""
    made = f"These recordings were made by {board.truth}"
    hidden = next((entry for entry in tested if entry.name == board.truth), None)
    leader = board.leader
    if hidden is None or leader is None:
        listed = any(entry.name == board.truth for entry in board.entries)
        return f"{made}, which is {'on this board without a rank' if listed else 'not on this board'}."
    if _computation(leader) == _computation(hidden):
        return f"{made}: the hidden network was found, it has the highest score."
    if not hidden.below_leader:
        return f"{made}: it is among those that are not told apart from the highest score."
    return f"{made}: the hidden network was not found, its rank is {hidden.rank}."


def _computation(entry: Entry) -> str:
    """Return one name for all entries of a computation."""
    return entry.same_as or entry.name


def _names(entries: Sequence[Entry]) -> str:
    return listing((entry.name for entry in entries), limit=4, quoted=False)
