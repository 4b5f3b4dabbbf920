"""Rare collections of garbage while many objects are made that stay."""

import contextlib
import gc
from collections.abc import Iterator

# Of new objects, and of younger collections for an older one. JAX alone has 400 000 objects.
RARELY = (500_000, 20, 100)


@contextlib.contextmanager
def rare_collections() -> Iterator[None]:
    """A context in which Python seldom looks for cyclic garbage.

    Imports and tracing make a million objects and hardly any garbage: the first sweep of a process
    takes 0.15 s less of 1.4 s.
    """
    former = gc.get_threshold()
    gc.set_threshold(*RARELY)
    try:
        yield
    finally:
        if former != RARELY:  # else another thread, or the command line, has set and restores it
            gc.set_threshold(*former)
