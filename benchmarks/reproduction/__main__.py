"""Judge every claim of the published study on a campaign of trainings, and write the page "What reproduces".

python -m benchmarks.reproduction leaderboards/reproduction --out docs
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.reproduction.campaign import read_campaign
from benchmarks.reproduction.page import write_page


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder with trainings.jsonl and records/")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the page and its figures")
    args = parser.parse_args()
    files, judged = write_page(read_campaign(args.folder), args.out)
    for item in judged:
        print(f"{item.claim.key:30} {item.rule:16} {item.verdict}")
    print(files[0])


if __name__ == "__main__":
    main()
