"""Largest counts in a case: more would take days or all memory, and are refused before any work.

No heavy imports: files are checked before anything is.
"""

import math
from typing import Any

# By the key of a list of parts, or of a whole number, wherever it stands in a case.
MAX_COUNTS = {
    "supports": 1000,
    "absorbers": 200,
    "actuators": 200,
    "sensors": 10_000,
    "vehicle_sensors": 10_000,
    "loads": 5000,
    "segments": 2000,
    "hinges": 1000,
    "bodies": 200,
    "springs": 1000,
    "axles": 1000,
    "coaches": 500,
    "modes": 1000,  # of the beam; more take minutes to compute
    "count": 2000,  # vehicles in a row
    "people": 10_000,
    "harmonics": 100,
    "waves": 100_000,  # of a random profile
    "points": 100_000,
    "order": 100,  # of a filter
    "power": 100,
    "horizon": 5000,  # periods of a prediction
    "moves": 1000,
    "terminal_periods": 10_000,
    "window": 1000,  # samples of a moving horizon
    "first": 5000,
    "more_delay": 1000,
    "max_delay_periods": 1000,
}
MAX_ENTRIES = 2_000_000  # numbers of one list, as points of a table, or of one matrix
MAX_WHEELS = 20_000  # of all loads together
MAX_SAMPLES = 10**8  # of a run, or time steps
MAX_SAMPLED = 4 * 10**9  # samples times sensors of a record


def check_length(address: str, length: int) -> None:
    """Validate the length of a list of parts. Raises ValueError with the largest allowed."""
    limit = MAX_COUNTS.get(address.rpartition(".")[2])
    if limit is not None and length > limit:
        raise ValueError(
            f"{address} has {length} entries; {limit} are the most that a case may have there:"
            " leave some out, or make several cases of it"
        )


def check_count(address: str, count: int) -> None:
    """Validate a whole number, as of modes. Raises ValueError with the largest allowed."""
    limit = MAX_COUNTS.get(address.rpartition(".")[2])
    if limit is not None and count > limit:
        raise ValueError(f"{address} must not exceed {limit}; it is {count}")


def check_entries(address: str, value: Any) -> None:
    """Validate the size of an array, or of a list, of numbers.

    Raises ValueError with the largest allowed.
    """
    size = len(value) if isinstance(value, list) else math.prod(getattr(value, "shape", ()))
    if size > MAX_ENTRIES:
        raise ValueError(f"{address} has {size} numbers; {MAX_ENTRIES} are the most")
