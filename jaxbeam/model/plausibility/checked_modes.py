"""Modes of a case with warnings of what looks wrong in its beam; `jaxbeam.modes`."""

import functools

from jaxbeam.case.case import Case, structure_of
from jaxbeam.model import modes as beam_modes
from jaxbeam.model.layout import Layout
from jaxbeam.model.modes import Modes
from jaxbeam.model.plausibility.check import warn_if_implausible


@functools.wraps(beam_modes.modes)
def modes(case: Case, layout: Layout | None = None) -> Modes:
    """`jaxbeam.model.modes.modes`, with warnings of implausible numbers; documented there."""
    found = beam_modes.modes(case, layout)
    warn_if_implausible(structure_of(case), found)
    return found
