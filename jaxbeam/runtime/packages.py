"""Imports of packages by name: own ones next to jaxbeam, and optional ones of its extras.

The names of `tuning` and `experiments`, next to jaxbeam, are common words: a file `tuning.py` in
the working folder would be found first in a notebook, with `python -m` or with PYTHONPATH.
"""

import importlib
import importlib.abc
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).resolve().parent.parent.parent
NAMES = ("tuning", "experiments")


class _SiblingFinder(importlib.abc.MetaPathFinder):
    """Finder of the two packages in the folder of jaxbeam, and of no others."""

    def find_spec(self, fullname, path, target=None):
        if fullname in NAMES:
            for finder in sys.meta_path:  # hooks of the tests before the one of Python
                spec = None if finder is self else finder.find_spec(fullname, [str(FOLDER)], target)
                if spec is not None:
                    return spec
        return None


_SIBLING_FINDER = _SiblingFinder()


def find_siblings() -> None:
    """Let `import tuning` and `import experiments` find the packages next to jaxbeam from now on.

    For processes that run programs of jaxbeam only.
    """
    if _SIBLING_FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _SIBLING_FINDER)


def own_package(name: str) -> ModuleType:
    """Package `tuning` or `experiments` next to jaxbeam, whatever the working folder contains.

    Raises ImportError, which names its file, if another module of the name has been imported.
    """
    module = sys.modules.get(name)
    if module is None:
        sys.meta_path.insert(0, _SIBLING_FINDER)
        try:
            module = importlib.import_module(name)
        finally:
            sys.meta_path.remove(_SIBLING_FINDER)
    file = getattr(module, "__file__", None) or "a namespace"
    if Path(file).resolve() != FOLDER / name / "__init__.py":
        raise ImportError(
            f"{file} was imported as {name!r}, the name of a package of jaxbeam: rename it, or"
            f" import jaxbeam.{name} before it"
        )
    return module


def import_extra(name: str, extra: str) -> ModuleType:
    """Import a library of an extra of jaxbeam. Raises ImportError, which says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(
            f"{name} is not installed; install jaxbeam with the extra {extra!r}: "
            f"pip install 'jaxbeam[{extra}]'"
        ) from None
