"""Command line of the benchmarks: ``python -m benchmarks NAME [--smoke] [--json FILE]``."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from benchmarks.harness import table, write_json

NOT_BENCHMARKS = {"__init__", "__main__", "harness"}


def names() -> list[str]:
    return sorted(p.stem for p in Path(__file__).parent.glob("*.py") if p.stem not in NOT_BENCHMARKS)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=names(), help="which benchmark")
    parser.add_argument("--smoke", action="store_true", help="smallest case: that it runs, no timing claims")
    parser.add_argument("--json", metavar="FILE", help="store the rows as JSON")
    chosen = parser.parse_args()
    rows = import_module(f"benchmarks.{chosen.name}").run(smoke=chosen.smoke)
    print(table(rows))
    if chosen.json:
        write_json(rows, chosen.json)


if __name__ == "__main__":
    main()
