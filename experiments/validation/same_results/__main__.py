"""Command line: write the results of a version, or compare those of two."""

import argparse
import sys
from pathlib import Path

from experiments.validation.same_results import comparison, writing


def main() -> None:
    """Write or compare. Raises SystemExit if a case fails or a difference is too large."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    writer = commands.add_parser("write", help="run all cases and store every number")
    writer.add_argument("output", type=Path, help="OUT.npz")
    writer.add_argument("--only", nargs="+", metavar="NAME", help="some of the cases")
    writer.add_argument("--jobs", type=int, default=2, help="processes in parallel")
    writer.add_argument("--checkout", type=Path, help="folder with another version")
    comparer = commands.add_parser("compare", help="compare two files, case by case")
    comparer.add_argument("first", type=Path)
    comparer.add_argument("second", type=Path)
    comparer.add_argument("--tolerance", type=float, default=comparison.TOLERANCE)
    arguments = parser.parse_args()
    if arguments.command == "compare":
        sys.exit(
            0 if comparison.compare(arguments.first, arguments.second, arguments.tolerance) else 1
        )
    names = arguments.only or list(writing.cases())
    writing.write(arguments.output, names, arguments.jobs, arguments.checkout)


if __name__ == "__main__":
    main()
