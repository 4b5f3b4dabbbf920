"""Figures of records, comparisons, modes, sweeps, fits, tunings and frequency responses.

Each function returns a matplotlib figure, which the caller saves. Figures are not registered with
pyplot: none is shown, and none needs to be closed.
"""

from jaxbeam.case.aliases import warn_renamed
from jaxbeam.plot.animation import animate
from jaxbeam.plot.compare import plot_comparison
from jaxbeam.plot.fit import FitPanel, plot_fit
from jaxbeam.plot.frequency import plot_frequency_response
from jaxbeam.plot.front import plot_pareto_front
from jaxbeam.plot.modes import plot_modes
from jaxbeam.plot.poles import plot_poles
from jaxbeam.plot.record import plot_record
from jaxbeam.plot.sweep import plot_sweep
from jaxbeam.plot.tuning import TuningPanel, plot_tuning

__all__ = [
    "FitPanel",
    "TuningPanel",
    "animate",
    "plot_comparison",
    "plot_fit",
    "plot_frequency_response",
    "plot_modes",
    "plot_pareto_front",
    "plot_poles",
    "plot_record",
    "plot_sweep",
    "plot_tuning",
]

OLD_NAMES = {"plot_frequency": "plot_frequency_response", "plot_front": "plot_pareto_front"}


def __getattr__(name: str):
    if name not in OLD_NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warn_renamed(f"jaxbeam.plot.{name}", f"jaxbeam.plot.{OLD_NAMES[name]}")
    return globals()[OLD_NAMES[name]]
