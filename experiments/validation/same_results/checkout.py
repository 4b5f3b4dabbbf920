"""Import of jaxbeam and tuning from another checkout; this module itself imports neither."""

import importlib
import os
import sys
from pathlib import Path


def import_from_checkout(folder: Path | None) -> None:
    """Import jaxbeam and tuning, from a checkout if one is given.

    Later imports of their modules follow; `experiments` stays that of this repository.
    """
    if folder is not None:
        sys.path.insert(0, os.fspath(folder))
    importlib.import_module("jaxbeam")
    importlib.import_module("tuning")
    if folder is not None:
        sys.path.pop(0)
