"""Which tests are slow, and which run at night only.

`nightly.txt` is written by hand, `slow.txt` by `python -m tests.layers.measure`: tests that took
more than 0.4 s of processor time. A line is a file, a test of it, or a test with its
parameters; those that begin with # are comments.
"""

import functools
from pathlib import Path

FOLDER = Path(__file__).parent


@functools.cache
def layers() -> tuple[frozenset[str], frozenset[str]]:
    """Names in nightly.txt and slow.txt."""
    nightly, slow = (
        frozenset(
            line
            for line in (FOLDER / name).read_text(encoding="utf-8").splitlines()
            if line and not line.startswith("#")
        )
        for name in ("nightly.txt", "slow.txt")
    )
    return nightly, slow


def matches(test: str, names: frozenset[str]) -> bool:
    """Whether a test is among the names, by itself, without its parameters, or by its file."""
    function, _, _ = test.partition("[")
    file, _, _ = function.partition("::")
    return not names.isdisjoint((test, function, file))
