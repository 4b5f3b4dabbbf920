"""Check of a case before it runs, by the table of plausible ranges, `ranges.toml`.

Wrong units make a case that computes and means nothing: E I in kN m^2, a speed in km/h, a mass in
t. What follows from them (first frequency, static deflection, mass ratio, critical speed) shows it.
"""

import contextvars
import dataclasses
import functools
import itertools
import math
import tomllib
import warnings
from collections.abc import Collection, Iterator, Sequence
from fnmatch import fnmatch
from importlib import resources
from typing import NamedTuple

import jax
import numpy as np

from jaxbeam.case.case import Case, concrete_case, structure_of
from jaxbeam.case.fields import all_concrete, concrete, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.model import modes as beam_modes
from jaxbeam.model.elements import Layout
from jaxbeam.model.modes import Modes
from jaxbeam.model.plausibility import loads, structure
from jaxbeam.model.plausibility.facts import Facts, Plausibility, plausible_numbers
from jaxbeam.model.plausibility.structure import Value, part_numbers

MOST_MODES = 60
LISTS = ("loads", "actuators", "sensors")  # whose parts have causes of their own


class Range(NamedTuple):
    """Row of `ranges.toml`, which says what its entries mean."""

    of: str
    within: tuple[float, float]
    says: str
    below: str = ""
    above: str = ""
    unit: str = ""
    cause: str = ""
    unless: Sequence[str] = ()
    over: str = ""
    kinds: Sequence[str] = ()

    def values(self, facts: Facts) -> Iterator[Value]:
        """Values of the quantity in a case, with addresses and words."""
        key, _, names = self.of.partition(": ")
        if names:
            return part_numbers(facts, key, *names.split(), over=self.over, kinds=self.kinds)
        return getattr(structure if hasattr(structure, key) else loads, key)(facts)


@functools.cache
def _rows(kind: str) -> tuple[Range, ...]:
    """Rows of `ranges.toml` of a kind, "range" or "advice", in their order."""
    text = (resources.files(__package__) / "ranges.toml").read_text(encoding="utf-8")
    return tuple(Range(**row) for row in tomllib.loads(text)[kind])


class PlausibilityWarning(UserWarning):
    """Warning of a number that computes but can hardly be meant, such as one in a wrong unit.

    >>> import warnings
    >>> import jaxbeam as jb
    >>> from jaxbeam.model.plausibility.check import PlausibilityWarning
    >>> beam = jb.Beam(25.0, flexural_rigidity=30e6, mass_per_length=15e3)  # kN m^2!
    >>> with warnings.catch_warnings(record=True) as shown:
    ...     warnings.simplefilter("always", PlausibilityWarning)
    ...     found = jb.modes(jb.Case(beam))
    >>> print(str(shown[0].message).split(" under")[0])
    beam.flexural_rigidity: the beam sags by 24.94 m
    """


@refuses_traced("a check")
def check(case: Case) -> Plausibility:
    """Characteristic numbers of a case, with warnings of implausible ones.

    Each warning names an address, what follows from the number there, and the likely mistake.
    Nothing is simulated; it takes a few milliseconds. Raises ValueError for an invalid case, and
    for one that is traced by JAX.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=25.0, flexural_rigidity=30e6, mass_per_length=15e3),  # kN m^2!
    ...     sensors=[jb.Sensor(position=12.5)],
    ...     loads=[jb.MovingMass(mass=30e3, speed=25.0)],
    ...     run=jb.Run(duration=2.0),
    ... )
    >>> found = jb.check(case)
    >>> print(found.span_over_deflection < 50)
    True
    >>> print(found.warnings[0].split(" under")[0])
    beam.flexural_rigidity: the beam sags by 3.186 m
    """
    check_case(case)
    return _checked(concrete_case(case), advised=True)


def warn_if_implausible(case: Case, found: Modes | None = None) -> None:
    """Warn of implausible numbers of a concrete case; its modes, if given, are `found`.

    Python shows each sentence once in a process, as all come from one place. An invalid case, or
    one without modes, gets its error from the function that uses it.
    """
    for sentence in _warnings_of(case, found) or ():
        warnings.warn(sentence, PlausibilityWarning, stacklevel=1)


def warn_if_implausible_sweep(cases: Sequence[Case], swept: Collection[str]) -> None:
    """Warn of implausible numbers of a sweep, whose extreme `cases` are given.

    A number outside the parts with `swept` addresses is warned of if it is implausible in all
    cases: an actuator may be too strong for the lightest load and right for the heaviest.
    """
    found = [sentences for case in cases if (sentences := _warnings_of(case)) is not None]
    by_address: dict[str, list[str]] = {}
    for sentence in itertools.chain.from_iterable(found):
        by_address.setdefault(sentence.partition(": ")[0], []).append(sentence)
    swept_parts = {_part(address) or address.partition(".")[0] for address in swept}
    for address, sentences in by_address.items():
        part = _part(address) or address.partition(".")[0]
        if len(sentences) >= len(found) or any(fnmatch(part, one) for one in swept_parts):
            warnings.warn(sentences[0], PlausibilityWarning, stacklevel=1)


def _warnings_of(case: Case, found: Modes | None = None) -> tuple[str, ...] | None:
    """Warnings of a case; None if they are left to the caller, or the case is traced or invalid."""
    if _SHOWN.get() or not all_concrete(case):
        return None
    try:
        if found is None:
            check_case(case)
        else:
            found = jax.tree.map(concrete, found)
        return _checked(concrete_case(case), found).warnings
    except (ValueError, np.linalg.LinAlgError, jax.errors.ConcretizationTypeError):
        return None


@functools.wraps(beam_modes.modes)
def modes(case: Case, layout: Layout | None = None) -> Modes:
    """`jaxbeam.model.modes.modes`, with warnings of implausible numbers; documented there."""
    found = beam_modes.modes(case, layout)
    warn_if_implausible(structure_of(case), found)
    return found


def leave_warnings_to_caller() -> None:
    """Silence `warn_if_implausible` in this context, whose caller shows the warnings of `check`."""
    _SHOWN.set(True)


_SHOWN = contextvars.ContextVar("plausibility_shown", default=False)


@np.errstate(all="ignore")  # of numbers that no beam has
def _checked(case: Case, found: Modes | None = None, advised: bool = False) -> Plausibility:
    found = beam_modes.modes(_with_few_modes(case)) if found is None else found
    numbers = plausible_numbers(case, found)
    rows = _rows("range") + (_rows("advice") if advised else ())
    return dataclasses.replace(numbers, warnings=tuple(_sentences(rows, case, found, numbers)))


def _with_few_modes(case: Case) -> Case:
    """The case with at most MOST_MODES modes, or what its track needs: hundreds take seconds."""
    enough = MOST_MODES
    if case.on_rail:
        enough = max(enough, case.track.least_modes(case.beam.length))
    count, ratios = min(case.beam.modes, enough), case.beam.damping_ratio
    ratios = ratios[:count] if np.ndim(ratios) else ratios
    beam = dataclasses.replace(case.beam, modes=count, damping_ratio=ratios)
    return dataclasses.replace(case, beam=beam)


def _sentences(rows: tuple[Range, ...], *judged) -> Iterator[str]:
    facts = Facts(*judged)
    explained: dict[str, set[str]] = {}  # parts of the case by the cause that has spoken of them
    for row in rows:
        said, fields = set(), set()
        for address, value, words in row.values(facts):
            part, field = _part(address), address.rstrip(".0123456789")
            if row.within[0] <= value <= row.within[1] or math.isnan(value) or field in fields:
                continue
            if explained.get(row.cause, set()) & {part, ""}:
                continue
            spoken = set().union(*(explained.get(cause, set()) for cause in row.unless))
            if spoken & {part, ""} or (spoken and not part):
                continue
            said.add(part)
            if field != address:  # of a list the first entry stands for all
                fields.add(field)
            yield _sentence(row, address, float(value), words)
        if row.cause:
            explained.setdefault(row.cause, set()).update(said)


def _part(address: str) -> str:
    """The part of a list that an address belongs to, such as "loads.0"; empty for others."""
    name, _, rest = address.partition(".")
    return f"{name}.{rest.split('.')[0]}" if name in LISTS else ""


def _sentence(row: Range, address: str, value: float, words: dict) -> str:
    low = value < row.within[0]
    says, hint = (
        text.format(address=address, value=value, **words)
        for text in (row.says, row.below if low else row.above)
    )
    bound = f"{'less' if low else 'more'} than {row.within[0 if low else 1]:g} {row.unit}".rstrip()
    return f"{address}: {says}{f', {bound}' if row.unit else ''}: {hint}"
