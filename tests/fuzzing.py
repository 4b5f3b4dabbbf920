"""How many random examples a test takes: few in each run of the tests, many at night.

`JAXBEAM_FUZZ=50` takes fifty times as many, other ones each time; `.ci/nightly` sets it.
"""

import os

FACTOR = int(os.environ.get("JAXBEAM_FUZZ", "1"))


def examples(count: int) -> int:
    """Number of examples of a test that takes `count` by default."""
    return count * FACTOR
