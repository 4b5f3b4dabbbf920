"""What the arguments of the command line mean, checked before any work is done."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.files.case_file import load_case, load_controller, with_settings
from jaxbeam.sweeps.batches import MAX_RUNS


def read_case(path: Path, settings: Iterable[str]) -> Case:
    """The case in a file, with the entries changed that the command line sets."""
    changes = dict(assignment("--set", text) for text in settings)
    return with_settings(load_case(path), {a: value_of(text) for a, text in changes.items()})


def read_controllers(
    path: Path, case: Case, files: Iterable[Path]
) -> dict[str, AbstractController]:
    """The controllers in some files, called after them, and first that of the case, if any.

    Raises ValueError if two files are of one name, or if there are no controllers at all.
    """
    found = {} if case.controller is None else {path.stem: case.controller}
    for file in files:
        if file.stem in found:
            raise ValueError(f"two controllers are called {file.stem}; rename a file")
        found[file.stem] = load_controller(file)
    if not found:
        raise ValueError(f"{path} has no controller; name some with --controllers FILE ...")
    return found


def assignment(option: str, text: str) -> tuple[str, str]:
    """The two sides of ADDRESS=VALUE. Raises ValueError if one is empty."""
    address, equals, value = text.partition("=")
    if not (address and equals and value):
        raise ValueError(f"{option} takes ADDRESS=VALUE, such as loads.0.speed=0.5, not {text!r}")
    return address, value


def value_of(text: str) -> Any:
    """A number, a list of numbers (with or without brackets), or else a word."""
    for read in (int, float):
        try:
            return read(text)
        except ValueError:
            pass
    try:
        return [float(entry) for entry in text.removeprefix("[").removesuffix("]").split(",")]
    except ValueError:
        return text


def sweep_values(over: Iterable[str]) -> dict[str, list[float]]:
    """The values by address of ADDRESS=START:STOP:COUNT or ADDRESS=V1,V2,...

    Raises ValueError if they are no numbers, or if an address is named twice.
    """
    values = {}
    for text in over:
        address, value = assignment("--over", text)
        if address in values:
            raise ValueError(f"--over names {address} twice; give all its values at once")
        if ":" not in value:
            values[address] = _numbers("--over", text, value.split(","))
            continue
        limits = _numbers("--over", text, value.split(":"))
        if len(limits) == 3 and limits[2] > MAX_RUNS:
            raise ValueError(f"--over {text}: a range may have {MAX_RUNS:.0e} values, no more")
        if len(limits) != 3 or limits[2] < 1 or limits[2] % 1:
            raise ValueError(
                f"--over {text}: a range is START:STOP:COUNT, such as 0.3:10:64, or a list 0.3,1,10"
            )
        values[address] = np.linspace(limits[0], limits[1], int(limits[2])).tolist()
    return values


def pair_of(text: str) -> tuple[str, str]:
    """The two words of INPUT:OUTPUT. Raises ValueError if one is empty."""
    source, colon, output = text.partition(":")
    if not (source and colon and output):
        raise ValueError(
            f"--pair takes INPUT:OUTPUT, such as actuators.0:sensors.0 or force@0.3:velocity@0.1,"
            f" not {text!r}"
        )
    return source, output


def parked_mass(text: str) -> tuple[float, float]:
    """The position and mass of POSITION=MASS. Raises ValueError if they are no two numbers."""
    numbers = _numbers("--mass-at", text, text.split("="))
    if len(numbers) != 2:
        raise ValueError(f"--mass-at takes POSITION=MASS in m and kg, such as 0.3=0.5, not {text}")
    return numbers[0], numbers[1]


def frequency_range(start: float, stop: float, points: int) -> list[float]:
    """Frequencies from start to stop (Hz) at equal ratios.

    Raises ValueError unless 0 < start < stop, and for fewer than two points.
    """
    if not 0 < start < stop < math.inf:
        raise ValueError(
            f"--from and --to must increase from above 0 Hz; they are {start:g}, {stop:g}"
        )
    if points < 2:
        raise ValueError(f"--points must be 2 or more; it is {points}")
    return np.geomspace(start, stop, points).tolist()


def split_files(files: Iterable[Path], free: Sequence[str]) -> tuple[Path | None, list[Path]]:
    """The case among the files (.toml), if there is one, and the logs.

    Raises ValueError without a log, with several cases, or with no case whose numbers are free.
    """
    cases = [path for path in files if path.suffix == ".toml"]
    logs = [path for path in files if path.suffix != ".toml"]
    if not logs:
        raise ValueError("identify needs at least one log: jaxbeam identify [CASE.toml] LOG...")
    if len(cases) > 1:
        raise ValueError(f"identify fits one case, not {len(cases)}: {', '.join(map(str, cases))}")
    if free and not cases:
        raise ValueError("--free needs the case whose numbers it names: identify CASE.toml LOG...")
    return (cases[0] if cases else None), logs


def _numbers(option: str, text: str, entries: Sequence[str]) -> list[float]:
    try:
        return [float(entry) for entry in entries]
    except ValueError as error:
        word = str(error).rsplit(": ", 1)[-1]
        raise ValueError(f"{option} {text}: {word} is not a number") from None


def bounds_of(text: str, option: str = "--free") -> tuple[str, tuple[float, float] | None]:
    """The address and the bounds of ADDRESS or ADDRESS=LOW:HIGH.

    Raises ValueError if the bounds are no two increasing numbers.
    """
    address, equals, value = text.partition("=")
    if not equals:
        return address, None
    bounds = _numbers(option, text, value.split(":"))
    if len(bounds) != 2 or bounds[0] >= bounds[1]:
        raise ValueError(f"{option} {text}: bounds are LOW:HIGH, such as 5:20")
    return address, (bounds[0], bounds[1])


def range_of(option: str, text: str, words: str) -> tuple[float, float]:
    """The two numbers of LOW:HIGH, a range in the words given. Raises ValueError otherwise."""
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise ValueError(f"{option} takes LOW:HIGH in {words}, not {text!r}") from None
    return low, high


def picture_path(output: Path | None, source: Path) -> Path:
    """Where a picture goes: beside the output, or named after the source in this folder."""
    return (output or Path(source.name)).with_suffix(".png")


def check_suffix(path: Path | None, suffix: str, content: str) -> None:
    """Raises ValueError if a file is not named as what will be in it."""
    if path and path.suffix != suffix:
        raise ValueError(
            f"{content} is written to a {suffix} file; call it {path.with_suffix(suffix)}"
        )


def refuse(given: bool, why: str) -> None:
    """Raises ValueError, saying why, if an option was given that cannot be followed."""
    if given:
        raise ValueError(why)


def check_outputs(overwrite: bool, *paths: Path | None) -> None:
    """Refuse, before any work, what could not be written after it.

    Raises FileNotFoundError without a folder to write to, FileExistsError for a file that exists
    and may not be overwritten.
    """
    for path in filter(None, paths):
        if not path.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {path.parent} to write {path.name} to")
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists; choose another name or add --overwrite")
