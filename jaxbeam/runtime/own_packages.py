"""The packages beside jaxbeam, `tuning` and `experiments`, found by location.

Their names are everybody's words: a file `tuning.py` in the working folder is found first wherever
Python looks there, as in a notebook, with `python -m` or with PYTHONPATH.
"""

import importlib
import importlib.abc
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).resolve().parent.parent.parent
NAMES = ("tuning", "experiments")


class _Beside(importlib.abc.MetaPathFinder):
    """Finds the two packages where jaxbeam is, and nothing else."""

    def find_spec(self, fullname, path, target=None):
        if fullname in NAMES:
            for finder in sys.meta_path:  # hooks of the tests before the one of Python
                spec = None if finder is self else finder.find_spec(fullname, [str(FOLDER)], target)
                if spec is not None:
                    return spec
        return None


_BESIDE = _Beside()


def find_beside() -> None:
    """From now on `import tuning` and `import experiments` take the packages beside jaxbeam.

    For processes that run programs of jaxbeam alone.
    """
    if _BESIDE not in sys.meta_path:
        sys.meta_path.insert(0, _BESIDE)


def own_package(name: str) -> ModuleType:
    """The package of a name beside jaxbeam, whatever else the folder has of that name.

    Raises ImportError, which names its file, if another module of the name has been imported.
    """
    module = sys.modules.get(name)
    if module is None:
        sys.meta_path.insert(0, _BESIDE)
        try:
            module = importlib.import_module(name)
        finally:
            sys.meta_path.remove(_BESIDE)
    file = getattr(module, "__file__", None) or "a namespace"
    if Path(file).resolve() != FOLDER / name / "__init__.py":
        raise ImportError(
            f"{file} was imported as {name!r}, the name of a package of jaxbeam: rename it, or"
            f" import jaxbeam.{name} before it"
        )
    return module
