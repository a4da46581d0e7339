"""List the campaigns that need a GPU, with what is open: ``python -m benchmarks.policies.jobs``."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("jobs.toml")
KEYS = {"name", "why", "minutes", "command", "then", "done", "result"}


def read_jobs(path: Path = FILE) -> list[dict[str, Any]]:
    """Return the jobs of a list, each with a name of its own and a command."""
    with path.open("rb") as stream:
        jobs = tomllib.load(stream)["jobs"]
    names = [job["name"] for job in jobs]
    for job in jobs:
        if odd := sorted(set(job) - KEYS):
            raise ValueError(f"Job {job['name']!r} has the key {odd[0]!r}; allowed: {sorted(KEYS)}.")
        if not job["command"] or names.count(job["name"]) > 1 or not job["minutes"] > 0:
            raise ValueError(f"Job {job['name']!r} needs a name of its own, a command and minutes above 0.")
    return jobs


def main() -> None:
    jobs = read_jobs()
    for job in jobs:
        state = f"done: {job['result']}" if job["result"] else f"open, {job['minutes']:g} device minutes"
        print(f"{job['name']} ({state})\n  {job['why']}\n  {job['command']}")
    print(f"{sum(job['minutes'] for job in jobs if not job['result']):g} device minutes are open.")


if __name__ == "__main__":
    main()
