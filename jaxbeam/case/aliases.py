"""Words of former versions, and those that replaced them; the old ones work, with a warning.

In case files, and in cases that are saved in records, stores of sweeps and fits, the warning is a
FutureWarning, which Python shows to everybody; for names in Python code it is a DeprecationWarning.
"""

import warnings
from collections.abc import Collection, Mapping
from typing import Any

NAMES = {  # of the package jaxbeam
    "Passage": "Feedforward",
    "Recognition": "LoadIdentification",
    "Relief": "InternalModel",
    "recognised": "identified_load",
}
KINDS = {"passage": "feedforward", "relief": "internal-model"}
KEYS = {
    "recognition": "load_identification",
    "places": "positions",
    "place_weight": "position_weight",
    "reach": "max_delay_periods",
}
# Words of case files that attributes in Python cannot have, and those that they have; both stay.
FILE_KEYS = {"class": "road_class", "heights": "point_heights"}


def warn_renamed(
    old: str, new: str, category: type[Warning] = DeprecationWarning, stacklevel: int = 3
) -> None:
    """Warn that a word has been replaced; `stacklevel` 3 blames the caller of the caller."""
    message = f"{old} is called {new} now; the old word will be removed"
    warnings.warn(message, category, stacklevel=stacklevel)


def renamed_property(old: str, new: str) -> property:
    """Property of a class that is the former name of its member `new`; it warns."""

    def value(self):
        warn_renamed(f"{type(self).__name__}.{old}", new)
        return getattr(self, new)

    return property(value, doc=f"Former name of `{new}`.")


def current_kind(address: str, kind: str) -> str:
    """The kind of a part, in its present word."""
    if kind not in KINDS:
        return kind
    warn_renamed(f"{address}.kind = {kind!r}", repr(KINDS[kind]), FutureWarning)
    return KINDS[kind]


def current_keys(
    address: str, table: Mapping[str, Any], allowed: Collection[str]
) -> dict[str, Any]:
    """A table of a case file with its keys in their present words, which are those in Python.

    A word that is among the allowed keys is left alone. Raises ValueError if the old and the new
    word are both there.
    """
    values = {}
    for key, value in table.items():
        new = (KEYS | FILE_KEYS).get(key, key) if key not in allowed else key
        if new != key and new in allowed:
            if new in table:
                where = "now" if key in KEYS else "in Python"
                raise ValueError(f"{address}.{key} is called {new} {where}; leave one of them out")
            if key in KEYS:
                warn_renamed(f"{address}.{key}", new, FutureWarning)
            key = new
        values[key] = value
    return values


def current_address(address: str) -> str:
    """An address in a case, such as "controller.recognition.until", in the present words."""
    names = [FILE_KEYS.get(name, name) for name in address.split(".")]
    current = [KEYS.get(name, name) for name in names]
    if current != names:
        warn_renamed(address, ".".join(current), FutureWarning)
    return ".".join(current)
