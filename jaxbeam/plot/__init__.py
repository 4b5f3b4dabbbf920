"""Figures of records, envelopes, comparisons, modes, sweeps, fits, tunings and frequency responses.

Each function returns a matplotlib figure, which the caller saves. Figures are not registered with
pyplot: none is shown, and none needs to be closed. The public names are listed in `__init__.pyi`;
each is imported when it is first used, since some need what takes as long as to draw a figure.
"""

import lazy_loader

from jaxbeam.case.aliases import warn_renamed

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

OLD_NAMES = {"plot_frequency": "plot_frequency_response", "plot_front": "plot_pareto_front"}


def __getattr__(name: str):
    if name in OLD_NAMES:
        warn_renamed(f"jaxbeam.plot.{name}", f"jaxbeam.plot.{OLD_NAMES[name]}")
        name = OLD_NAMES[name]
    return _import_name(name)
