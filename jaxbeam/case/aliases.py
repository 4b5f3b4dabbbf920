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
    """A table of a case file with its keys in their present words.

    A word that is among the allowed keys is left alone. Raises ValueError if the old and the new
    word are both there.
    """
    values = {}
    for key, value in table.items():
        new = KEYS.get(key, key) if key not in allowed else key
        if new != key and new in allowed:
            if new in table:
                raise ValueError(f"{address}.{key} is called {new} now; leave one of them out")
            warn_renamed(f"{address}.{key}", new, FutureWarning)
            key = new
        values[key] = value
    return values


def current_address(address: str) -> str:
    """An address in a case, such as "controller.recognition.until", in the present words."""
    current = ".".join(KEYS.get(name, name) for name in address.split("."))
    if current != address:
        warn_renamed(address, current, FutureWarning)
    return current
