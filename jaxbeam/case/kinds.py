"""Kinds: the classes of a family, such as actuators, by the words that name them in case files.

A class that declares `kind: ClassVar[str] = "point"` below the abstract class of its family is
found by that word; nothing else registers it.
"""

import importlib
import pkgutil


def import_modules(package_name: str) -> None:
    """Import all modules of a package and of the packages in it, so that their kinds are known."""
    package = importlib.import_module(package_name)
    for module in pkgutil.walk_packages(package.__path__, f"{package_name}."):
        importlib.import_module(module.name)


def kind_of(part_class: type) -> str | None:
    """The kind that a class declares itself, or None; a kind is not inherited."""
    kind = vars(part_class).get("kind")
    return kind if isinstance(kind, str) else None


def kinds(family: type) -> dict[str, type]:
    """Classes below an abstract class by their kinds, in alphabetical order.

    A class defined again, as in a notebook, takes the place of the former one. Raises TypeError if
    two classes declare the same kind.
    """
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
