"""Pictures of records, comparisons, modes, sweeps, fits, tunings and frequency responses.

Each function returns a figure, which the caller saves. The figures do not belong to pyplot:
nothing is shown, and nothing has to be closed.
"""

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
    "plot_pareto_front",
    "plot_modes",
    "plot_poles",
    "plot_record",
    "plot_sweep",
    "plot_tuning",
]
