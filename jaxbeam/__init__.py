"""jaxbeam: structures under moving loads, simulated and differentiated with JAX.

The public names are listed in `__init__.pyi`; each is imported when it is first used, so that
`import jaxbeam` and the help of the command line need not wait for JAX.
"""

import os
import sys

import lazy_loader

# Matrices are small here and runs share the cores: threads of LAPACK would wait for each other, on
# a busy machine for minutes. LAPACK reads this when it is loaded; a setting by the user prevails.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Peaks to one part in a million need double precision. JAX reads this when it is imported; a
# setting by the user prevails.
if "JAX_ENABLE_X64" not in os.environ:
    os.environ["JAX_ENABLE_X64"] = "1"
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
