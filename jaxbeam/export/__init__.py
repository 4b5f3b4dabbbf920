"""What leaves for real controllers: programs in C99, FMI units, gains as CSV, .mat, TDMS or C."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
