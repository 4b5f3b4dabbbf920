"""Figures of records, envelopes, comparisons, modes, sweeps, fits, tunings and frequency responses.

Each function returns a matplotlib figure, which the caller saves. Figures are not registered with
pyplot: none is shown, and none needs to be closed. The public names are listed in `__init__.pyi`;
each is imported when it is first used, since some need what takes as long as to draw a figure.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
