"""jaxbeam: beams under moving loads, simulated, controlled and differentiated with JAX.

The public names are listed in `__init__.pyi`. Each is imported when it is first used, so that
`import jaxbeam` and the help of the command line do not import JAX, which takes a second.
"""

import importlib
import importlib.util
import os
import sys

from jaxbeam.runtime.early_interrupt import exit_on_interrupt, is_command_line

if is_command_line():
    exit_on_interrupt()  # before what takes long to import

import lazy_loader

from jaxbeam.case.former_words import MOVED, NAMES

# Public names that are modules, with the packages in which they are.
MODULES = {
    "ride": "jaxbeam.analysis",
    "receptance_method": "jaxbeam.control",
    "frequency_responses": "jaxbeam.model",
    "vehicles": "jaxbeam.case.loads",
    "actuators": "jaxbeam.case",
    "statics": "jaxbeam.model",
    "profiles": "jaxbeam.case",
    "sections": "jaxbeam.analysis",
    "benchmark": "jaxbeam",
}

# Matrices are small and runs share the cores: threads of LAPACK would wait for each other, on a
# busy machine for minutes. LAPACK reads this when it is loaded; a setting by the user prevails.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "numpy" in sys.modules:
        import threadpoolctl

        threadpoolctl.threadpool_limits(1, user_api="blas")

# Peaks to one part in a million need double precision. JAX reads this when it is imported; a
# setting by the user prevails.
if "JAX_ENABLE_X64" not in os.environ:
    os.environ["JAX_ENABLE_X64"] = "1"
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)

if importlib.util.find_spec("jax") is None:  # in a browser: known numbers need NumPy alone
    from jaxbeam.runtime import without_jax

    without_jax.install()

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def _version() -> str:
    """Version of the installed package; "unknown" for its files alone, as in a browser."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("jaxbeam")
    except PackageNotFoundError:
        return "unknown"


def __getattr__(name: str):
    if name in NAMES and name not in __all__:
        raise AttributeError(f"jaxbeam.{name} is called jaxbeam.{NAMES[name]} now")
    if name in MOVED:
        raise AttributeError(f"jaxbeam.{name} is jaxbeam.{MOVED[name]}.{name} now")
    if name == "__version__":
        return _version()
    if name in MODULES:
        return importlib.import_module(f"{MODULES[name]}.{name}")
    return _import_name(name)
