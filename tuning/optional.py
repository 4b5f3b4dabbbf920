"""Optional libraries, installed with extras and imported where they are used."""

import importlib
from types import ModuleType


def import_extra(name: str, extra: str) -> ModuleType:
    """Import a library of an extra of jaxbeam. Raises ImportError, which says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(
            f"{name} is not installed; install jaxbeam with the extra {extra!r}: "
            f"pip install 'jaxbeam[{extra}]'"
        ) from None
