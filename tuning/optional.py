"""Libraries that come with extras only, and are imported where they are used."""

import importlib
from types import ModuleType


def import_extra(name: str, extra: str) -> ModuleType:
    """Import a library of one of jaxbeam's extras. Raises ImportError, saying how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(
            f"{name} is not installed; install jaxbeam with the extra {extra!r}: "
            f"pip install 'jaxbeam[{extra}]'"
        ) from None
