"""Arguments of `identify_modes`, checked before any work."""

from collections.abc import Sequence

from tuning.logs.log import Log
from tuning.modal.forced.blows import Windows, check_windows

KINDS = ("free decay", "ambient")
DECAY = "decay"  # the method for free decays; the others are for responses to broadband forces
METHODS = (DECAY, "covariance", "data", "fdd", "plscf")


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


def check_force(
    force: Sequence[str] | None, force_window: float | None, kind: str | None, method: str | None
) -> None:
    """Check a measured force, and its window, beside the kind of excitation and the method.

    Raises ValueError for either beside a kind, or with a method that does not use it, and for a
    window that does not last.
    """
    check_windows(Windows(force=force_window))
    if force is None and force_window is None:
        return
    if method not in (None, "plscf"):
        raise ValueError(f"a measured force is used by method 'plscf', not by {method!r}")
    if kind is not None:
        raise ValueError(f"with a measured force the excitation is known; leave out kind {kind!r}")


def check_arguments(
    count: int | None, kind: str | None, order: int | None, method: str | None
) -> None:
    """Check arguments that need no log.

    Raises ValueError for a count or order that is too small, an unknown kind or method, and a kind
    or an order that the method cannot use.
    """
    if count is not None and count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if order is not None and order < 4:
        raise ValueError(f"the highest order must be at least 4, not {order}")
    if kind not in (None, *KINDS):
        raise ValueError(f"kind must be {' or '.join(map(repr, KINDS))}, not {kind!r}")
    if method not in (None, *METHODS):
        raise ValueError(f"method must be {' or '.join(map(repr, METHODS))}, not {method!r}")
    if kind == "free decay" and method not in (None, DECAY):
        raise ValueError(
            f"method {method!r} takes a log for the response to broadband excitation; for kind "
            "'free decay' leave the method out"
        )
    if kind == "ambient" and method == DECAY:
        raise ValueError("method 'decay' fits free decays; for kind 'ambient' leave the method out")
    if order is not None and method == "fdd":
        raise ValueError("method 'fdd' has no models and no order; leave the order out")


def check_choice(count: int | None, exclude: Sequence[float], choose: Sequence[float]) -> None:
    """Check frequencies (Hz) of modes that are chosen.

    Raises ValueError for frequencies that are not positive, and beside a number of modes or
    excluded frequencies, as all modes are chosen then.
    """
    wrong = [frequency for frequency in choose if not 0 < frequency < float("inf")]
    if wrong:
        raise ValueError(f"modes are chosen by frequencies above 0 Hz, not {wrong[0]:g} Hz")
    if len(choose) and (count is not None or len(exclude)):
        other = "exclude" if count is None else "count"
        raise ValueError(f"chosen modes are all that are kept; leave out {other}")
