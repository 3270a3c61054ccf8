"""Command line of the benchmarks: ``python -m benchmarks NAME [--smoke] [--json FILE] [--plot DIR]``."""

from __future__ import annotations

import argparse
from importlib import import_module
from inspect import signature
from pathlib import Path

from benchmarks.harness import pin, table, write_json

NOT_BENCHMARKS = {"harness"}


def names() -> list[str]:
    """Modules of this folder that are benchmarks; a leading underscore says that one is not."""
    found = (p.stem for p in Path(__file__).parent.glob("*.py") if not p.stem.startswith("_"))
    return sorted(set(found) - NOT_BENCHMARKS)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=names(), help="which benchmark")
    parser.add_argument("--smoke", action="store_true", help="smallest case: that it runs, no timing claims")
    parser.add_argument("--json", metavar="FILE", help="store the rows as JSON")
    parser.add_argument("--plot", metavar="DIR", help="draw work-precision curves into this folder")
    chosen = parser.parse_args()
    run = import_module(f"benchmarks.{chosen.name}").run
    more = {}
    if chosen.plot:
        if "plot" not in signature(run).parameters:
            parser.error(f"{chosen.name} draws nothing: leave --plot out.")
        more = {"plot": Path(chosen.plot)}
    print(f"{chosen.name}: {pin()}", flush=True)
    rows = run(smoke=chosen.smoke, **more)
    print(table(rows))
    if chosen.json:
        write_json(rows, chosen.json)


if __name__ == "__main__":
    main()
