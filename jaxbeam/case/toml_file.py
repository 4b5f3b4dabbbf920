"""TOML files as dictionaries, quantities with a unit ("25 m") in SI units, and largest counts.

No heavy imports, so that errors in a file appear at once, before any work. Units are those of pint,
which is imported (0.3 s) when the first such text is met.
"""

import functools
import math
import os
import re
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from jaxbeam.runtime.input_file import read_text_input

# By the key of a list of parts, or of a whole number, wherever it stands in a case.
MAX_COUNTS = {
    "supports": 1000,
    "absorbers": 200,
    "actuators": 200,
    "active": 200,  # of them
    "sensors": 10_000,
    "vehicle_sensors": 10_000,
    "loads": 5000,
    "segments": 2000,
    "hinges": 1000,
    "bodies": 200,
    "springs": 1000,
    "axles": 1000,
    "coaches": 500,
    "modes": 1000,  # of the beam; more take minutes to compute
    "count": 2000,  # vehicles in a row
    "people": 10_000,
    "harmonics": 100,
    "waves": 100_000,  # of a random profile
    "points": 100_000,
    "order": 100,  # of a filter
    "power": 100,
    "horizon": 5000,  # periods of a prediction
    "moves": 1000,
    "terminal_periods": 10_000,
    "window": 1000,  # samples of a moving horizon
    "first": 5000,
    "more_delay": 1000,
    "max_delay_periods": 1000,
}
MAX_ENTRIES = 2_000_000  # numbers of one list, as points of a table, or of one matrix
MAX_WHEELS = 20_000  # of all loads together
MAX_SAMPLES = 10**8  # of a run, or time steps
MAX_SAMPLED = 4 * 10**9  # samples times sensors of a record


def check_length(address: str, length: int) -> None:
    """Validate the length of a list of parts. Raises ValueError with the largest allowed."""
    limit = MAX_COUNTS.get(address.rpartition(".")[2])
    if limit is not None and length > limit:
        raise ValueError(
            f"{address} has {length} entries; {limit} are the most that a case may have there:"
            " leave some out, or make several cases of it"
        )


def check_count(address: str, count: int) -> None:
    """Validate a whole number, as of modes. Raises ValueError with the largest allowed."""
    limit = MAX_COUNTS.get(address.rpartition(".")[2])
    if limit is not None and count > limit:
        raise ValueError(f"{address} must not exceed {limit}; it is {count}")


def check_entries(address: str, value: Any) -> None:
    """Validate the size of an array, or of a list, of numbers.

    Raises ValueError with the largest allowed.
    """
    size = len(value) if isinstance(value, list) else math.prod(getattr(value, "shape", ()))
    if size > MAX_ENTRIES:
        raise ValueError(f"{address} has {size} numbers; {MAX_ENTRIES} are the most")


_LISTED = re.compile(r"^[ \t]*\[\[[ \t]*(\w+)[ \t]*\]\]", re.MULTILINE)  # [[sensors]]
MAX_DEPTH = 32  # of tables and lists within each other; no file that people write comes near


def read_toml(
    path: str | os.PathLike,
    what: str = "case file",
    below: Path | None = None,
    address: str = "",
) -> dict[str, Any]:
    """Tables of a file, validated as TOML only; `what` it is to the user.

    A file that another one names at an `address` must be `below` the folder of that one. Raises
    OSError if the file cannot be read, ValueError if it is elsewhere, too large, not UTF-8, not
    valid TOML, nested without end, or has more tables than a case may have; both name the file.
    """
    text = read_text_input(path, what, below, address)
    try:
        return parse_toml(text, quoted=below is None)  # nothing of other files
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_toml(text: str, quoted: bool = True) -> dict[str, Any]:
    """Tables of a text, validated as TOML only.

    Raises ValueError as `read_toml`, with a hint on a wrong value, which may be `quoted` in it.
    """
    for name, count in Counter(_LISTED.findall(text)).items():
        check_length(name, count)  # to parse so many would take long
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # RecursionError: lists nested without end
        hint = _hint(text, str(error)) if quoted else ""
        raise ValueError(f"not valid TOML: {error}{hint}") from None
    if _depth_exceeds(content, MAX_DEPTH):
        raise ValueError(f"tables or lists are nested more than {MAX_DEPTH} deep")
    return content


def _hint(text: str, error: str) -> str:
    """What is likely wrong with the value of the line of an error, or nothing."""
    found = re.search(r"at line (\d+)", error)
    line = text.splitlines()[int(found[1]) - 1] if found else ""
    value = line.partition("=")[2].split("#")[0].strip()
    if re.fullmatch(r"[-+]?\d+,\d+", value):
        return f": write a decimal point, {value.replace(',', '.')}"
    if re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)? *[a-zA-Zµ%].*", value):
        return f': put a number with a unit in quotes, "{value}"'
    if re.fullmatch(r"[a-zA-Z][\w-]*", value):
        return f': put a word in quotes, "{value}"'
    return ""


def _depth_exceeds(content: Any, limit: int) -> bool:
    """Whether tables and lists are nested deeper than a limit; without recursion."""
    level: list[Any] = [content]
    for _ in range(limit + 1):
        level = [
            inner
            for one in level
            for inner in (one.values() if isinstance(one, dict) else one)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return False
    return True


# A number and a unit: "m", "kN m^2", "%", and after a space "1/s".
QUANTITY = re.compile(
    r"\s*((?>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?))"
    r"\s*((?:(?<=\s)1\s*/\s*)?[^\W\d_][\w\s*/^().-]*|[%°])\s*"
)
SIGNS = str.maketrans({"·": "*", "×": "*", "⋅": "*", "−": "-"})
SI_WORDS = {"1": "dimensionless"}
RATES = ("Hz", "1/s", "rad/s")  # cycles or radians: the one is 2 pi times the other


def is_quantity(text: Any) -> bool:
    """Whether a value is a text of a number and a unit, such as "25 m"."""
    return isinstance(text, str) and QUANTITY.fullmatch(text.translate(SIGNS)) is not None


def number_and_unit(text: str) -> tuple[float, str]:
    """Number and unit of a quantity, as written. Raises ValueError if it is none."""
    found = QUANTITY.fullmatch(text.translate(SIGNS))
    if found is None:
        raise ValueError(f"{text!r} is no number with a unit, such as '25 m'")
    return float(found.group(1)), found.group(2).strip()


def in_si(value: Any, unit: str, name: str) -> Any:
    """A value with quantities, in itself or in nested lists, replaced by numbers in SI units.

    `unit` is the SI unit of the entry called `name`; "1/s, s" those of the entries of a list. What
    is no quantity stays as it is. Raises ValueError, with name, text and wanted unit, for a unit
    that does not exist or measures something else.
    """
    if isinstance(value, list | tuple):
        units = unit.split(", ") if ", " in unit else [unit] * len(value)
        if len(units) != len(value):
            units = [unit] * len(value)
        entries = enumerate(zip(value, units, strict=True))
        return [in_si(one, one_unit, f"{name}.{i}") for i, (one, one_unit) in entries]
    return _number_in_si(value, unit, name) if is_quantity(value) else value


def number_in_si(value: Any, unit: str, name: str) -> float:
    """A number, or a text with a number and perhaps a unit, as a number in a SI unit.

    Raises ValueError, with `name` and text, for anything else.
    """
    converted = in_si(value, unit, name)
    try:
        return float(converted)
    except (TypeError, ValueError):
        wanted = "a plain number" if unit == "1" else f"a number in {unit}, or one with a unit"
        raise ValueError(f"{name} takes {wanted}, not {value!r}") from None


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _number_in_si(text: str, unit: str, name: str) -> float:
    number, given = number_and_unit(text)
    if re.search(r"\btons?\b", given):
        raise ValueError(
            f"{name}: a ton may be metric or not; write 't' or 'short_ton', not {text!r}"
        )
    wanted = "a plain number" if unit == "1" else f"in {unit}"
    units = _registry()
    try:
        target = units.Unit(SI_WORDS.get(unit, unit.replace("^", "**")))
    except Exception:  # the unit of a command, of a state
        raise ValueError(
            f"{name} takes plain numbers, as its unit depends on other entries ({unit}); it is"
            f" {text!r}"
        ) from None
    try:
        quantity = units.Quantity(1.0, given)
    except Exception:  # whatever a parser may raise
        raise ValueError(
            f"{name} must be {wanted}; {text!r} has an unknown unit: write powers and"
            " products as in 'kN m^2'"
        ) from None
    if not quantity.is_compatible_with(target):
        raise ValueError(f"{name} must be {wanted}, or a unit of the same kind, not {text!r}")
    if unit in RATES and _is_rotation(quantity, unit):
        raise ValueError(
            f"{name} must be {wanted}, not {text!r}: cycles and radians differ by 2 pi, so give the"
            " number itself"
        )
    return number * float(quantity.to(target).magnitude)


def _is_rotation(quantity: Any, unit: str) -> bool:
    """Whether a rate is in cycles where radians are wanted, or the other way round."""
    in_radians = "radian" in str(quantity.to_root_units().units)
    in_cycles = "hertz" in str(quantity.units)
    return in_radians != (unit == "rad/s") or (in_cycles and unit != "Hz")


# Words of case files that attributes in Python cannot have, and those that they have; both stay.
FILE_KEYS = {"class": "road_class", "heights": "point_heights"}


def with_attribute_names(
    address: str, table: Mapping[str, Any], allowed: Collection[str]
) -> dict[str, Any]:
    """A table of a case file with its keys as they are called in Python.

    A word that is among the allowed keys is left alone. Raises ValueError if both words are there.
    """
    values = {}
    for key, value in table.items():
        new = key if key in allowed else FILE_KEYS.get(key, key)
        if new not in allowed:
            new = key
        if new != key and new in table:
            raise ValueError(f"{address}.{key} is called {new} in Python; leave one of them out")
        values[new] = value
    return values


def attribute_address(address: str) -> str:
    """An address in a case with the words of attributes in Python."""
    return ".".join(FILE_KEYS.get(name, name) for name in address.split("."))
