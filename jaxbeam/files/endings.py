"""Endings of the files that results are written to, and optional packages, installed with extras.

Nothing heavy is imported, so that the command line checks endings at once.
"""

import importlib
import importlib.util
import os
from pathlib import Path
from types import ModuleType

from jaxbeam.runtime.output_file import check_named

TABLES = (".csv", ".xlsx", ".mat", ".parquet")  # columns of numbers with heads
DATASETS = (".nc", ".zarr")  # everything, with units and coordinates
RESULTS = (*DATASETS, *TABLES)
PACKAGES = {".xlsx": "openpyxl", ".parquet": "pyarrow"}


def check_ending(path: str | os.PathLike, content: str, allowed: tuple[str, ...] = RESULTS) -> None:
    """Check that a result can be written to a file by its ending.

    Raises ValueError for no name, or another ending than those allowed; ImportError, with what to
    install, if the package that writes it is missing.
    """
    check_named(path)
    ending = Path(path).suffix
    if ending not in allowed:
        first = Path(path).with_suffix(allowed[0])
        more = [one for one in dict.fromkeys(allowed) if one != allowed[0]]
        others = f", or {', '.join(more)}" if more else ""
        raise ValueError(f"{content} is written to a {allowed[0]} file; call it {first}{others}")
    package = PACKAGES.get(ending, "")
    if package and importlib.util.find_spec(package) is None:
        raise ImportError(
            f"{ending} files need {package}, which is not installed: pip install {package}, or"
            " 'jaxbeam[tables]'"
        )


def import_extra(name: str, extra: str) -> ModuleType:
    """Import a library of an extra of jaxbeam. Raises ImportError, which says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(
            f"{name} is not installed; install jaxbeam with the extra {extra!r}: "
            f"pip install 'jaxbeam[{extra}]'"
        ) from None
