"""The command line: reads arguments, calls the library, prints what it returns.

Commands are in one file for each kind of work. Libraries are imported inside the commands, so that
help and complaints come at once.
"""

import atexit
import gc
import os
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn

from cyclopts import CycloptsError

from jaxbeam.cli import (
    checking,
    comparing,
    compiling,
    exporting,
    identifying,
    judging,
    reproducing,
    simulating,
    tuning,
    weighing,
)
from jaxbeam.cli.app import app, print_message

__all__ = [
    "checking",
    "comparing",
    "compiling",
    "exporting",
    "identifying",
    "judging",
    "main",
    "reproducing",
    "simulating",
    "tuning",
    "weighing",
]


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command line (that of the process by default) and exit: 0, or 1 where it is wrong.

    A mistake of the user ends in one sentence on standard error, a warning is one as well.
    """
    warned = set()  # what is checked twice warns twice

    def warn(message, *_, **__):
        if str(message) not in warned:
            warned.add(str(message))
            print_message(f"warning: {message}")

    warnings.showwarning = warn
    if arguments is None:
        _relax_garbage_collection()
        _enable_compile_cache()
    try:
        app(arguments, exit_on_error=False, print_error=False)
    except MemoryError as error:
        print_message(f"not enough memory: {error}")
        sys.exit(1)
    except (ValueError, OSError, RuntimeError, ImportError, CycloptsError) as error:
        print_message(" ".join(str(error).split()))
        sys.exit(1)
    sys.exit(0)


def _relax_garbage_collection() -> None:
    """Look for garbage rarely, and not at the end: tracing makes very many objects, hardly any of
    them garbage, and to look through all of them again when the process ends takes a second.
    """
    gc.set_threshold(50_000, 20, 100)
    atexit.register(gc.freeze)


def _enable_compile_cache() -> None:
    """Keep compiled programs from one command to the next, in the user's cache folder.

    JAX_COMPILATION_CACHE_DIR names another folder; empty, it keeps nothing.
    """
    import jax

    from jaxbeam.runtime.compile_cache import cache_folder

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
