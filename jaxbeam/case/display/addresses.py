"""Addresses of a case in words: "speed of load 1" for `loads.1.speed`."""

from jaxbeam.case.case import Case, unit_at
from jaxbeam.case.joint_addresses import ALL

SINGULARS = {"bodies": "body", "masses": "mass"}


def address_words(case: Case, address: str) -> str:
    """What a number or word of a case is: "speed of the load", "stiffness of support 1".

    A part that is the only one of its list has no number; a sensor with a name has its name. A
    train of the library is called so.
    """
    *keys, field = address.split(".")
    entry = ""
    while field.isdigit() and keys:
        entry, field = f" {field}{entry}", keys.pop()
    owners, part = [], case
    for key in keys:
        if key.isdigit() or key == ALL:
            owners[-1] = _of_list(part, owners[-1], key)
            part = part[0 if key == ALL else int(key)] if isinstance(part, tuple) else None
        else:
            owners.append(key)
            part = getattr(part, key, None)
    owners = [one if " " in one else f"the {_spaced(one)}" for one in owners if one != "run"]
    if owners and owners[-1] == f"the {field}":  # a train of the library
        return field
    return " of ".join([f"{_spaced(field)}{entry}", *reversed(owners)])


def value_words(case: Case, address: str, value: float | str) -> str:
    """A value at an address with its SI unit: "speed of the load: 2 m/s"."""
    words = address_words(case, address)
    if isinstance(value, str):
        return f"{words}: {value}"
    unit = unit_at(case, address)
    return f"{words}: {value:.6g} {'' if unit == '1' else unit}".rstrip()


def _of_list(parts, key: str, index: str) -> str:
    """Words for one part of a list, or all of them: "load 1", "the load", "all loads"."""
    count = len(parts) if isinstance(parts, tuple) else 2
    one = SINGULARS.get(key, key.removesuffix("s"))
    part = parts[0 if index == ALL else int(index)] if isinstance(parts, tuple) else None
    if key == "loads" and getattr(part, "train", ""):
        one = "train"
    name = getattr(part, "name", "") if key == "sensors" and index != ALL else ""
    if name:
        return f"sensor {name}"
    if count == 1:
        return f"the {_spaced(one)}"
    return f"all {_spaced(key)}" if index == ALL else f"{_spaced(one)} {index}"


def _spaced(name: str) -> str:
    return name.replace("_", " ").replace("youngs", "Young's")
