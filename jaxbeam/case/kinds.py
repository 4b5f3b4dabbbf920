"""Kinds: the classes of a family, such as actuators, by the words that name them in case files.

A class that declares `kind: ClassVar[str] = "point"` below the abstract class of its family is
found by that word; nothing else registers it. A case names few kinds, and most modules take longer
to import than to read: only those are imported whose source declares a kind that is asked for.
"""

import functools
import importlib
import importlib.util
import pkgutil
import re
from collections.abc import Iterator
from importlib.abc import InspectLoader

PACKAGES = ("jaxbeam.case", "jaxbeam.control", "jaxbeam.estimation")  # with parts of cases
_DECLARATION = re.compile(r'^    kind: ClassVar\[str\] = "(.+)"', re.MULTILINE)


def module_names(package_name: str) -> Iterator[str]:
    """Names of all modules of a package and of the packages in it, which are imported."""
    package = importlib.import_module(package_name)
    for module in pkgutil.walk_packages(package.__path__, f"{package_name}."):
        yield module.name


def import_modules(package_name: str) -> None:
    """Import all modules of a package and of the packages in it."""
    for name in module_names(package_name):
        importlib.import_module(name)


@functools.cache
def _modules_by_kind() -> dict[str, list[str]]:
    """Modules of PACKAGES by the kinds that their sources declare.

    A module without a source is imported, so that its classes are known.
    """
    modules: dict[str, list[str]] = {}
    for name in (name for package in PACKAGES for name in module_names(package)):
        spec = importlib.util.find_spec(name)
        loader = spec and spec.loader
        source = loader.get_source(name) if isinstance(loader, InspectLoader) else None
        if source is None:
            importlib.import_module(name)
        for kind in _DECLARATION.findall(source or ""):
            modules.setdefault(kind, []).append(name)
    return modules


def kind_of(part_class: type) -> str | None:
    """The kind that a class declares itself, or None; a kind is not inherited."""
    kind = vars(part_class).get("kind")
    return kind if isinstance(kind, str) else None


def find_kind(family: type, kind: str) -> type | None:
    """The class of a kind below an abstract class, or None; raises as `kinds`."""
    for name in _modules_by_kind().get(kind, ()):
        importlib.import_module(name)
    return _imported_kinds(family).get(kind)


def kinds(family: type) -> dict[str, type]:
    """Classes below an abstract class by their kinds, in alphabetical order.

    A class defined again, as in a notebook, takes the place of the former one. Raises TypeError if
    two classes declare the same kind.
    """
    for package in PACKAGES:
        import_modules(package)
    return _imported_kinds(family)


def _imported_kinds(family: type) -> dict[str, type]:
    classes: dict[str, type] = {}
    for part_class in _subclasses(family):
        kind = kind_of(part_class)
        if kind is None:
            continue
        other = classes.get(kind, part_class)
        if _full_name(other) != _full_name(part_class):
            raise TypeError(
                f"the kind {kind!r} is declared by both {_full_name(other)} and"
                f" {_full_name(part_class)}: give one of them another kind"
            )
        classes[kind] = part_class
    return dict(sorted(classes.items()))


def _subclasses(part_class: type) -> list[type]:
    """All subclasses in order of their definition, level by level."""
    direct = part_class.__subclasses__()
    return direct + [deeper for each in direct for deeper in _subclasses(each)]


def _full_name(part_class: type) -> str:
    return f"{part_class.__module__}.{part_class.__qualname__}"
