"""Meaning of arguments, checked before any work; imports nothing heavy at the top."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxbeam.case.toml_file import is_quantity, number_and_unit
from jaxbeam.runtime.output_file import check_ending

if TYPE_CHECKING:
    from jaxbeam.case.case import Case

MAX_POINTS = 10**6  # of a grid of frequencies or a table
Bounds = tuple[float, float] | tuple[str, str]  # in SI units, or texts with units


class UsageError(ValueError):
    """Error in the words of a command line, not in what they name; the exit status is 2."""


def parse_assignment(option: str, text: str) -> tuple[str, str]:
    """Address and value of ADDRESS=VALUE. Raises UsageError if one is empty."""
    address, equals, value = text.partition("=")
    if not (address and equals and value):
        raise UsageError(f"{option} takes ADDRESS=VALUE, such as loads.0.speed=0.5, not {text!r}")
    return address, value


def parse_value(text: str) -> Any:
    """Value of a text: a number, a list of numbers (with or without brackets), or else a word.

    Quantities, as "25 m", are words.
    """
    for read in (int, float):
        try:
            return read(text)
        except ValueError:
            pass
    entries = text.removeprefix("[").removesuffix("]").split(",")
    if len(entries) > 1 and any(map(is_quantity, entries)):
        return [entry.strip() if is_quantity(entry) else parse_value(entry) for entry in entries]
    try:
        return [float(entry) for entry in entries]
    except ValueError:
        return text


def named_number(option: str, text: str, example: str) -> tuple[str, float]:
    """Name and number of NAME=NUMBER. Raises UsageError, with the example, otherwise."""
    name, numbers = named_numbers(option, text, "NAME=NUMBER", example)
    if len(numbers) != 1:
        raise UsageError(f"{option} takes NAME=NUMBER, such as {example}, not {text!r}")
    return name, numbers[0]


def named_numbers(
    option: str, text: str, form: str, example: str, number: Callable[[str], Any] = float
) -> tuple[str, list[Any]]:
    """Name and numbers of NAME=NUMBER,NUMBER,...

    Raises UsageError, with the form and the example, if the name is empty or a number is none.
    """
    name, _, value = text.partition("=")
    refusal = UsageError(f"{option} takes {form}, such as {example}, not {text!r}")
    if not name:
        raise refusal
    try:
        return name, [number(entry) for entry in value.split(",")]
    except ValueError:
        raise refusal from None


def parse_sweep_values(texts: Iterable[str]) -> dict[str, list[float] | list[str]]:
    """Values by address of ADDRESS=START:STOP:COUNT or ADDRESS=V1,V2,..., numbers or all words.

    Raises UsageError for numbers among words, if a range has too many numbers or is one of MATLAB,
    or if an address is named twice.
    """
    values = {}
    for text in texts:
        address, value = parse_assignment("--over", text)
        if address in values:
            raise UsageError(f"--over names {address} twice; give all its values at once")
        if ":" in value:
            values[address] = _range_values(text, value)
        else:
            entries = value.split(",")
            is_word = [bool(entry) and isinstance(parse_value(entry), str) for entry in entries]
            values[address] = entries
            if not all(is_word):
                values[address] = _parse_numbers("--over", text, entries)
    return values


def _range_values(text: str, value: str) -> list[Any]:
    first, *rest = value.split(":")
    if len(rest) == 2 and is_quantity(first):
        return _quantity_range(text, first, *rest)
    limits = _parse_numbers("--over", text, value.split(":"))
    if len(limits) != 3 or not (limits[2] >= 1 and limits[2] % 1 == 0):
        raise UsageError(
            f"--over {text}: a range is START:STOP:COUNT, such as 0.3:10:64, or a list 0.3,1,10"
        )
    start, stop, count = limits
    if 0 < stop < start < count:
        raise UsageError(
            f"--over {text}: a range is START:STOP:COUNT, not START:STEP:STOP: in steps of {stop:g}"
            f" write {start:g}:{count:g}:{(count - start) // stop + 1:g}, and {count:g} values"
            f" downwards as {stop:g}:{start:g}:{count:g}"
        )
    import numpy as np

    from jaxbeam.simulation.sweeps import MAX_VALUES

    if count > MAX_VALUES:
        raise UsageError(f"--over {text}: a range may have {MAX_VALUES:.0e} values, no more")
    return np.linspace(start, stop, int(count)).tolist()


def _quantity_range(text: str, start: str, stop: str, count: str) -> list[str]:
    """Quantities of START:STOP:COUNT with a unit, as 60 km/h:200 km/h:15."""
    (first, unit), (last, other) = number_and_unit(start), (0.0, "")
    if is_quantity(stop):
        last, other = number_and_unit(stop)
    if unit != other:
        raise UsageError(
            f"--over {text}: both ends of a range have the same unit, as in 60 km/h:200 km/h:15"
        )
    values = _range_values(text, f"{first!r}:{last!r}:{count}")
    return [f"{value!r} {unit}" for value in values]


def input_output_pair(text: str) -> tuple[str, str]:
    """Input and output of INPUT:OUTPUT. Raises UsageError if one is empty."""
    source, colon, output = text.partition(":")
    if not (source and colon and output):
        raise UsageError(
            f"--pair takes INPUT:OUTPUT, such as actuators.0:sensors.0 or force@0.3:velocity@0.1,"
            f" not {text!r}"
        )
    return source, output


def stationary_mass(text: str) -> tuple[float, float]:
    """Position (m) and mass (kg) of POSITION=MASS. Raises UsageError if they are no two numbers."""
    numbers = _parse_numbers("--mass-at", text, text.split("="))
    if len(numbers) != 2:
        raise UsageError(f"--mass-at takes POSITION=MASS in m and kg, such as 0.3=0.5, not {text}")
    return numbers[0], numbers[1]


def check_points(points: int) -> None:
    """Check the number of points of a grid or a table.

    Raises UsageError unless it is from 2 to MAX_POINTS.
    """
    if not 2 <= points <= MAX_POINTS:
        raise UsageError(f"--points must be from 2 to {MAX_POINTS:.0e}; it is {points}")


def frequency_grid(start: float, stop: float, points: int) -> list[float]:
    """Frequencies (Hz) from start to stop, logarithmically spaced.

    Raises UsageError unless 0 < start < stop, and 2 <= points <= MAX_POINTS.
    """
    if not 0 < start < stop < math.inf:
        raise UsageError(
            f"--from and --to must increase from above 0 Hz; they are {start:g}, {stop:g}"
        )
    check_points(points)
    import numpy as np

    return np.geomspace(start, stop, points).tolist()


def split_case_and_logs(
    files: Iterable[Path], free_addresses: Sequence[str]
) -> tuple[Path | None, list[Path]]:
    """Case file (.toml), if there is one, and logs among the files.

    Raises UsageError without a log, for several cases, and for a free parameter without a case.
    """
    cases = [path for path in files if path.suffix == ".toml"]
    logs = [path for path in files if path.suffix != ".toml"]
    if not logs:
        raise UsageError("identify needs at least one log: jaxbeam identify [CASE.toml] LOG...")
    if len(cases) > 1:
        raise UsageError(f"identify fits one case, not {len(cases)}: {', '.join(map(str, cases))}")
    if free_addresses and not cases:
        raise UsageError("--free needs the case whose numbers it names: identify CASE.toml LOG...")
    return (cases[0] if cases else None), logs


def parse_bounds(text: str, option: str = "--free") -> tuple[str, Bounds | None]:
    """Address and bounds of ADDRESS or ADDRESS=LOW:HIGH; None without bounds.

    Bounds with units, as 8 GN m^2:12 GN m^2, stay texts until the case is read (`bounds_in_si`).
    Raises UsageError if the bounds are no two increasing numbers, or one alone has a unit.
    """
    address, equals, value = text.partition("=")
    if not equals:
        return address, None
    entries = [entry.strip() for entry in value.split(":")]
    with_units = _both_with_units(f"{option} {text}", entries)
    if with_units is not None:
        return address, with_units
    bounds = _parse_numbers(option, text, entries)
    if len(bounds) != 2 or bounds[0] >= bounds[1]:
        raise UsageError(f"{option} {text}: bounds are LOW:HIGH, such as 5:20")
    return address, (bounds[0], bounds[1])


def _both_with_units(option: str, entries: list[str]) -> tuple[str, str] | None:
    """Two texts with units, None if none has one. Raises UsageError if only some have."""
    with_unit = [is_quantity(entry) for entry in entries]
    if len(entries) == 2 and all(with_unit):
        return entries[0], entries[1]
    if any(with_unit):
        raise UsageError(f"{option}: give both numbers a unit, as in 8 GN m^2:12 GN m^2")
    return None


def bounds_in_si(
    case: "Case", bounds: Mapping[str, Bounds | None], option: str = "--free"
) -> dict[str, tuple[float, float] | None]:
    """Bounds by address in the SI units of a case.

    Raises UsageError for an address that the case lacks, a unit that does not fit, and bounds that
    do not increase.
    """
    converted = {}
    for address, pair in bounds.items():
        if pair is not None and isinstance(pair[0], str):
            pair = pair_in_si(case, address, pair, option)
            if pair[0] >= pair[1]:
                raise UsageError(f"{option} {address}: bounds are LOW:HIGH, such as 5:20")
        converted[address] = pair
    return converted


def pair_in_si(case: "Case", address: str, pair: Bounds, option: str) -> tuple[float, float]:
    """Two values at an address, numbers or texts with units, in the SI unit that it has in a case.

    Raises UsageError for an address that the case lacks, and a unit that does not fit.
    """
    if not any(isinstance(value, str) for value in pair):
        return float(pair[0]), float(pair[1])
    from jaxbeam.case.case import unit_at, value_at
    from jaxbeam.case.toml_file import in_si

    value_at(case, address)  # says what is wrong with the address
    first, second = in_si(list(pair), unit_at(case, address), f"{option} {address}")
    return first, second


def parse_prior(text: str) -> tuple[str, Bounds]:
    """Address, mean and deviation of ADDRESS=MEAN:DEVIATION, texts with units as they are.

    Raises UsageError if they are no two numbers, or one alone has a unit.
    """
    address, value = parse_assignment("--prior", text)
    entries = [entry.strip() for entry in value.split(":")]
    with_units = _both_with_units(f"--prior {text}", entries)
    if with_units is not None:
        return address, with_units
    try:
        mean, deviation = map(float, entries)
    except ValueError:
        raise UsageError(
            "--prior takes ADDRESS=MEAN:DEVIATION, such as beam.damping_ratio=0.02:0.005, not"
            f" {text!r}"
        ) from None
    return address, (mean, deviation)


def parse_range(option: str, text: str, unit_and_example: str) -> tuple[float, float]:
    """Two numbers of LOW:HIGH. Raises UsageError, with unit and example, otherwise."""
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise UsageError(f"{option} takes LOW:HIGH in {unit_and_example}, not {text!r}") from None
    return low, high


def _parse_numbers(option: str, text: str, entries: Sequence[str]) -> list[float]:
    try:
        return [float(entry) for entry in entries]
    except ValueError as error:
        word = str(error).rsplit(": ", 1)[-1]
        raise UsageError(f"{option} {text}: {word} is not a number") from None


def figure_path(output: Path | None, source: Path) -> Path:
    """File of a picture: beside the output, or named after the source in this folder."""
    return (output or Path(source.name)).with_suffix(".png")


INCHES = {"mm": 1 / 25.4, "cm": 1 / 2.54, "in": 1.0}
MIN_INCHES, MAX_INCHES = 1.0, 100.0


def parse_size(text: str) -> tuple[float, float]:
    """Width and height in inches of WIDTHxHEIGHT with a unit, as 160x100mm.

    Raises UsageError for other texts, and for sizes below one inch or above 100.
    """
    found = re.fullmatch(r"(\d+\.?\d*)\s*x\s*(\d+\.?\d*)\s*(mm|cm|in)", text.strip())
    if found is None:
        raise UsageError(
            f"--size takes WIDTHxHEIGHT in mm, cm or in, such as 160x100mm, not {text!r}"
        )
    width, height = (float(found.group(i)) * INCHES[found.group(3)] for i in (1, 2))
    if not MIN_INCHES <= min(width, height) <= max(width, height) <= MAX_INCHES:
        raise UsageError(f"--size {text}: a side is 25 mm at least and 2540 mm at most")
    return width, height


def check_exists(kind: str, *paths: Path) -> None:
    """Check that files of a kind, as "log file", exist. Raises FileNotFoundError otherwise."""
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path}: there is no such {kind}")


def check_suffix(path: Path | None, suffix: str, content: str, others: Sequence[str] = ()) -> None:
    """Check, before any work, that a file can be written by its suffix.

    Raises UsageError for another suffix than that of its content or one of the others, ImportError
    if the package that writes it is not installed.
    """
    if path:
        check_ending(path, content, (suffix, *others))


def refuse_option(is_given: bool, reason: str) -> None:
    """Check that an option that does not apply is absent. Raises UsageError with the reason."""
    if is_given:
        raise UsageError(reason)
