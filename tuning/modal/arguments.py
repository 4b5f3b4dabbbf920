"""Settings and arguments of `identify_modes`, checked before any work, and the choice of modes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tuning.logs.log import Log
from tuning.modal.forced.forces import Windows, check_windows
from tuning.modal.result import IdentifiedMode

KINDS = ("free decay", "ambient")
DECAY = "decay"  # the method for free decays; the others are for responses to broadband forces
MOST_ORDER = 1000  # of a model, the work for which grows with its fourth power
METHODS = (DECAY, "covariance", "data", "plscf")  # the last is for measured forces


@dataclass(frozen=True)
class ModalSettings:
    """Settings of `identify_modes`, apart from the part of the log and the method.

    `count` modes are kept, those with most energy. `exclude` are frequencies (Hz) that are no
    modes. The modes nearest to the frequencies `choose` (Hz) are kept, also those that are not well
    identified, and no others. `order` is the highest order of the stabilisation diagram. `force`
    are the names of the channels of forces that were measured, of a hammer or shaker, by default
    all in N; a force that one of several logs lacks, as of a hammer that strikes another place in
    each, is zero there. `force_window` (s) is the time after each impact of a hammer from which on
    the force is taken for zero. Readings that a logger repeats are decimated, and zeros before a
    sensor has answered interpolated, but with samples `as_logged`.

    Raises ValueError for a count below one, an order below four or above MOST_ORDER, frequencies
    to choose that are not positive, and a choice with a count or excluded frequencies, as it
    chooses all modes.

        >>> ModalSettings(count=3, exclude=[50.0]).count
        3
        >>> ModalSettings(count=0)
        Traceback (most recent call last):
            ...
        ValueError: count must be at least 1, not 0
    """

    count: int | None = None
    exclude: Sequence[float] = ()
    choose: Sequence[float] = ()
    order: int | None = None
    force: Sequence[str] | None = None
    force_window: float | None = None
    as_logged: bool = False

    def __post_init__(self):
        if self.count is not None and self.count < 1:
            raise ValueError(f"count must be at least 1, not {self.count}")
        if self.order is not None and not 4 <= self.order <= MOST_ORDER:
            raise ValueError(f"the highest order must be from 4 to {MOST_ORDER}, not {self.order}")
        wrong = [frequency for frequency in self.choose if not 0 < frequency < float("inf")]
        if wrong:
            raise ValueError(f"modes are chosen by frequencies above 0 Hz, not {wrong[0]:g} Hz")
        if len(self.choose) and (self.count is not None or len(self.exclude)):
            other = "exclude" if self.count is None else "count"
            raise ValueError(f"chosen modes are all that are kept; leave out {other}")
        check_windows(Windows(force=self.force_window))


def check_band(log: Log, rate: float, band: tuple[float, float] | None) -> None:
    """Check a band (Hz) for a log of some sampling rate (Hz).

    Raises ValueError for a band that ends before it begins, or that is not within 0 and half the
    sampling rate.
    """
    if band is not None and band[0] >= band[1]:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz must end above where it "
            "begins"
        )
    if band is not None and not 0 < band[0] < band[1] <= rate / 2:
        raise ValueError(
            f"{log.source}: the band from {band[0]:g} Hz to {band[1]:g} Hz is not within 0 and "
            f"half the sampling rate, {rate / 2:g} Hz"
        )


def check_force(settings: ModalSettings, kind: str | None, method: str | None) -> None:
    """Check that a measured force, or its window, is used.

    Raises ValueError for either with a kind, or with a method that does not use it.
    """
    if settings.force is None and settings.force_window is None:
        return
    if method not in (None, "plscf"):
        raise ValueError(f"a measured force is used by method 'plscf', not by {method!r}")
    if kind is not None:
        raise ValueError(f"with a measured force the excitation is known; leave out kind {kind!r}")


def check_method(kind: str | None, method: str | None) -> None:
    """Check the kind of excitation and the method.

    Raises ValueError for an unknown kind or method, and a kind that the method cannot use.
    """
    if kind not in (None, *KINDS):
        raise ValueError(f"kind must be {' or '.join(map(repr, KINDS))}, not {kind!r}")
    if method == "fdd":
        raise ValueError(
            "method 'fdd' is gone: other methods find more modes and smaller errors of damping; "
            "use 'covariance' or 'data'"
        )
    if method not in (None, *METHODS):
        raise ValueError(f"method must be {' or '.join(map(repr, METHODS))}, not {method!r}")
    if kind == "free decay" and method not in (None, DECAY):
        raise ValueError(
            f"method {method!r} takes a log for the response to broadband excitation; for kind "
            "'free decay' leave the method out"
        )
    if kind == "ambient" and method == "plscf":
        raise ValueError(
            "method 'plscf' fits the responses to measured forces; for kind 'ambient' use "
            "'covariance' or 'data'"
        )
    if kind == "ambient" and method == DECAY:
        raise ValueError("method 'decay' fits free decays; for kind 'ambient' leave the method out")


MAX_DISTANCE = 0.02  # relative distance of a mode from the frequency that chooses it

Judged = tuple[IdentifiedMode, str]  # a mode and the reason for rejecting it, or none


def chosen_modes(
    judged: Sequence[Judged], frequencies: Sequence[float], source: str
) -> tuple[list[Judged], list[Judged], list[str]]:
    """The modes nearest to frequencies (Hz), the others, and warnings about chosen ones.

    Raises ValueError for a frequency without a mode within 2 %, and for two that choose one mode.
    """
    chosen: dict[int, float] = {}
    notes = []
    for frequency in frequencies:
        places = sorted(range(len(judged)), key=lambda k: abs(judged[k][0].frequency - frequency))
        found = judged[places[0]][0].frequency if places else math.inf
        if abs(found - frequency) > MAX_DISTANCE * frequency:
            near = f"the nearest is {found:.4g} Hz" if places else "there are none"
            raise ValueError(
                f"{source}: no pole within {100 * MAX_DISTANCE:g} % of the chosen {frequency:g} Hz;"
                f" {near}. Choose frequencies that are printed without a choice"
            )
        nearest = places[0]
        if nearest in chosen:
            raise ValueError(
                f"{source}: {chosen[nearest]:g} Hz and {frequency:g} Hz choose one mode, that of"
                f" {found:.4g} Hz; give one of them, or frequencies nearer to two modes"
            )
        chosen[nearest] = frequency
        if reason := judged[nearest][1]:
            notes.append(f"{found:.4g} Hz is chosen, though {reason}")
    others = [
        (mode, reason or "not chosen") for k, (mode, reason) in enumerate(judged) if k not in chosen
    ]
    return [(judged[k][0], "") for k in chosen], others, notes
