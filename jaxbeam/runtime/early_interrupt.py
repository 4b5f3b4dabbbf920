"""Ctrl-C while a command is imported: it has nothing to lose yet and ends at once, in one line.

Imported before all else by `jaxbeam`, so that it imports nothing that Python has not yet.
"""

import _signal  # pyright: ignore[reportMissingImports]  # `signal` takes milliseconds to import
import os
import sys

STATUS = 130  # 128 + SIGINT, as shells have it


def is_command_line() -> bool:
    """Whether this process is `jaxbeam ...` or `python -m jaxbeam ...`."""
    words = sys.orig_argv
    if os.path.basename(sys.argv[0] if sys.argv else "") in ("jaxbeam", "jaxbeam.exe"):
        return True
    return "-m" in words[:-1] and words[words.index("-m") + 1] == "jaxbeam"


def exit_on_interrupt() -> None:
    """End this process on SIGINT, from now on, in one line and with status 130."""

    def end(*_):
        os.write(2, b"jaxbeam: interrupted before any work\n")
        os._exit(STATUS)

    _signal.signal(_signal.SIGINT, end)
