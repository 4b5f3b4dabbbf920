"""Writers of C code by the class of a designed law, filter or source of the load.

To make a law exportable, register a writer for its class in a file of `jaxbeam.c_code.laws`:
`write_law` for a sampled law, `write_state_law` for one that is fed by an estimate of the state,
`write_filter` for a filter, `write_load_source` for a source of the load. Files there are found.
"""

from functools import singledispatch
from typing import Any, NamedTuple

from jaxbeam.c_code.source import CSource


class NoCCodeError(ValueError):
    """Error of a law without a writer."""


class EstimateCode(NamedTuple):
    """C expressions of an estimate: state, weights of the wheels, states of vehicles, or None.

    `states` and `wheels` are numbers of entries. `loads` are positions (m), then speeds (m/s), then
    masses (kg) of loads that are followed.
    """

    state: str
    states: int
    weights: str | None = None
    wheels: int = 0
    vehicles: str | None = None
    loads: str | None = None


class LoadCode(NamedTuple):
    """C expressions of the load: mass (kg), speed (m/s), entry (s), and which are identified."""

    mass: str
    speed: str
    entry_time: str
    speed_identified: str
    mass_identified: str


def no_c_code(part: Any) -> NoCCodeError:
    """Error for a law, filter or source of a class that has no writer."""
    return NoCCodeError(f"there is no code for its {type(part).__name__} in jaxbeam.c_code.laws")


@singledispatch
def write_law(law: Any, code: CSource) -> None:
    """Write a step of a sampled law: readings, acting command and time to the wanted command.

    Raises NoCCodeError for a class that has no writer.
    """
    raise no_c_code(law)


@singledispatch
def write_filter(filter: Any, code: CSource) -> EstimateCode:
    """Write an update of a filter; the C expressions of its estimate.

    Raises NoCCodeError for a class that has no writer.
    """
    raise no_c_code(filter)


@singledispatch
def write_state_law(law: Any, code: CSource, estimate: EstimateCode) -> None:
    """Write a step of a law that is fed by an estimate, to the wanted command.

    Raises NoCCodeError for a class that has no writer.
    """
    raise no_c_code(law)


@singledispatch
def write_load_source(source: Any, code: CSource) -> LoadCode:
    """Write an update of a source of the load; the C expressions of its estimate.

    Raises NoCCodeError for a class that has no writer.
    """
    raise no_c_code(source)
