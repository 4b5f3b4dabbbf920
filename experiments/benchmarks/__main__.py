"""All benchmarks, or those named, one after the other, each in a process of its own.

    python -m experiments.benchmarks [NAME ...] [--list]

Each prints its table; one that fails is named at the end, and the others still run. What a single
one takes as options, `python -m experiments.benchmarks.NAME --help` says.
"""

import argparse
import subprocess
import sys

NAMES = {
    "sweep": "sweeps and their derivatives, against scipy and diffrax",
    "kernel": "sweeps, against the same method by hand in C",
    "growth": "time and peak memory of sweeps as they grow, and what compiling takes",
    "identify": "identification, against scipy's least squares",
    "riccati": "designs of regulators, many at once",
    "steps": "steps of controllers",
    "tuners": "tuning by gradients, beside differential evolution",
    "profile": "where the time of a sweep goes",
    "cluster": "a sweep of a million runs on workers",
}


def main() -> None:
    """Run benchmarks. Raises SystemExit if one fails, or has no such name."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="; ".join(f"{name}: {about}" for name, about in NAMES.items()),
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="one of those below; all if none")
    parser.add_argument("--list", action="store_true", help="only say which there are")
    given = parser.parse_args()
    unknown = set(given.names) - set(NAMES)
    if unknown:
        parser.error(f"no benchmark {', '.join(sorted(unknown))}; there are {', '.join(NAMES)}")
    failed = []
    for name in given.names or NAMES:
        print(f"\n## {name}: {NAMES[name]}\n" if not given.list else f"{name:10} {NAMES[name]}")
        sys.stdout.flush()
        command = [sys.executable, "-m", f"experiments.benchmarks.{name}"]
        if not given.list and subprocess.run(command).returncode:
            failed.append(name)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
