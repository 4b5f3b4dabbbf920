"""Measure the tests, and write those that are slow into slow.txt.

    python -m tests.layers.measure [pytest options]

runs the tests in one process, with those of the night, and prints the processor time of each layer.
"""

import os
import sys
from pathlib import Path

import pytest

from tests.layers.selection import FOLDER, layers, matches

SLOW = 0.4  # s of processor time, child processes included, from which on a test is slow


def processor_seconds() -> float:
    """Processor time (s) of this process and of those that it started and that ended."""
    return sum(os.times()[:4])


class Stopwatch:
    """Processor seconds of each test; those of a test's fixtures are its own."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        start = processor_seconds()
        result = yield
        self.seconds[item.nodeid] = processor_seconds() - start
        return result


def main(arguments: list[str]) -> int:
    """Run pytest with some arguments, write slow.txt, and return pytest's exit status."""
    watch = Stopwatch()
    status = pytest.main(["-n", "0", "--nightly", *arguments], plugins=[watch])
    write(watch.seconds, FOLDER / "slow.txt")
    nightly, slow = layers()
    late = sum(s for test, s in watch.seconds.items() if matches(test, nightly))
    quick = sum(s for test, s in watch.seconds.items() if s <= SLOW and not matches(test, nightly))
    total = sum(watch.seconds.values())
    print(f"processor time: quick {quick:.0f} s, daily {total - late:.0f} s, nightly {total:.0f} s")
    return status


def write(seconds: dict[str, float], path: Path) -> None:
    """Names of the tests that are slow, one a line."""
    slow = sorted(test for test, s in seconds.items() if s > SLOW)
    path.write_text(
        "\n".join(["# Written by tests.layers.measure.", *slow]) + "\n", encoding="utf-8"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
