"""Free memory, memory of the blocks of a computation, and results that are kept in memory."""

import os
import re
from pathlib import Path

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
