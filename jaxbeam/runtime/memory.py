"""Free memory, memory of the blocks of a computation, and results that are kept in memory."""

import collections
import dataclasses
import functools
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

DEFAULT_PART = 4  # blocks take a quarter of what is free: other programs need some, too
UNKNOWN = 2 * 2**30  # bytes, assumed on a machine that does not report free memory
UNITS = {"": 1.0, "B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
UNITS |= {"KiB": 2.0**10, "MiB": 2.0**20, "GiB": 2.0**30, "TiB": 2.0**40}
GROUPS = Path("/sys/fs/cgroup")  # of control groups, by which containers limit memory


def block_memory(given: float | str | None = None) -> float:
    """Memory (bytes) that the blocks of a computation may take together.

    By default a quarter of what is free now; else as `given` in bytes or with a unit ("2 GB").
    Raises ValueError for anything else.
    """
    if given is None:
        return free_memory() / DEFAULT_PART
    parts = re.fullmatch(r"\s*([\d.eE+]+)\s*([A-Za-z]*)\s*", str(given))
    try:
        found = float(parts[1]) * UNITS[parts[2]] if parts else 0.0
    except (KeyError, ValueError):
        found = 0.0
    if not 0 < found < float("inf"):
        raise ValueError(f"memory is a number of bytes or a text as '2 GB', not {given!r}")
    return found


def free_memory() -> float:
    """Memory (bytes) that this process can still take: of machine, container and its own limit."""
    limits = [_of_machine(), _of_container(), _of_process()]
    return max(0.0, min((limit for limit in limits if limit is not None), default=UNKNOWN))


def size_text(size: float) -> str:
    """A size (bytes) in words, as "1.5 GB"."""
    unit = next((name for name in ("GB", "MB") if size >= UNITS[name]), "kB")
    return f"{size / UNITS[unit]:.3g} {unit}"


def _of_machine() -> float | None:
    """Memory (bytes) available without swapping; half of the total where only that is known."""
    try:
        text = Path("/proc/meminfo").read_text()
        return 1024.0 * int(re.findall(r"^MemAvailable:\s*(\d+)", text, re.M)[0])
    except (OSError, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2
    except (OSError, ValueError, AttributeError):
        return None


def _of_container() -> float | None:
    """Memory (bytes) left by the control group of this process; cached files count as free."""
    for most, used, cached in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            limit, taken = (int((GROUPS / name).read_text()) for name in (most, used))
            statistics = (GROUPS / most).with_name("memory.stat").read_text()
        except (OSError, ValueError):  # none, or no limit ("max")
            continue
        found = re.findall(rf"^{cached} (\d+)", statistics, re.M)
        return float(limit - taken + int(found[0] if found else 0))
    return None


def _of_process() -> float | None:
    """Memory (bytes) left by the limit of the address space (`ulimit -v`)."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        return float(limit - pages * os.sysconf("SC_PAGE_SIZE"))
    except (ImportError, OSError, ValueError):
        return None


KEPT_RESULTS = 4


@dataclasses.dataclass(frozen=True)
class _Content:
    """Key of the cache: structure, shapes and numbers of a tree."""

    structure: Any
    numbers: tuple[tuple[tuple[int, ...], bytes], ...]
    tree: Any = dataclasses.field(compare=False)


def remembered(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Decorator: cache the latest results of a function of one tree of concrete numbers.

    Results must not be changed, as callers get the same object. Sweeps that are repeated for other
    loads take 3 ms less of 24 (4096 crossings, three modes, in C).
    """

    @functools.lru_cache(maxsize=KEPT_RESULTS)
    def result_for(content: _Content):
        return function(content.tree)

    @functools.wraps(function)
    def call(tree):
        leaves, structure = jax.tree.flatten(tree)
        arrays = map(np.asarray, leaves)
        numbers = tuple((array.shape, array.tobytes()) for array in arrays)
        return result_for(_Content(structure, numbers, tree))

    return call


def remembered_within(size: float) -> Callable[[Callable], Callable]:
    """Decorator: cache the latest results of a function, up to a total `size` (bytes).

    Arguments are hashable, results are trees of arrays, which must not be changed.
    """

    def decorate(function: Callable) -> Callable:
        kept: collections.OrderedDict[tuple, tuple[Any, int]] = collections.OrderedDict()
        lock = threading.Lock()

        @functools.wraps(function)
        def call(*arguments):
            with lock:
                if arguments in kept:
                    kept.move_to_end(arguments)
                    return kept[arguments][0]
            result = function(*arguments)
            own = sum(getattr(leaf, "nbytes", 0) for leaf in jax.tree.leaves(result))
            with lock:
                kept[arguments] = result, own
                while sum(part for _, part in kept.values()) > size:
                    kept.popitem(last=False)
            return result

        return call

    return decorate
