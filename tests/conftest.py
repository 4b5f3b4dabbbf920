"""Settings of all tests, before any other import.

float64 is not set here: importing `jaxbeam` sets it, for the tests as for users.
"""

import collections
import gc
import importlib.metadata
import os
import sys
import tempfile

# No window, with or without a screen; also in processes that a test starts.
os.environ["MPLBACKEND"] = "Agg"
# Tables are as wide as they need, whatever the terminal; test processes are told its width.
os.environ.pop("COLUMNS", None)
# Several test processes share a GPU: none may allocate most of its memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
# Test processes share the cores: threads of small matrix products would wait for each other, on a
# busy machine ten times as long as they compute. A plugin of pytest may have loaded NumPy before.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if "numpy" in sys.modules:
    import threadpoolctl

    threadpoolctl.threadpool_limits(1, user_api="blas")
# Compiling takes most of the time of the tests: the settings of `jaxbeam.runtime.compiling`, and
# without optimisations, whose time small cases do not regain.
os.environ["XLA_FLAGS"] = " ".join(
    [
        "--xla_backend_optimization_level=0",
        "--xla_cpu_parallel_codegen_split_count=1",
        os.environ.get("XLA_FLAGS", ""),
    ]
)
if importlib.metadata.version("jaxlib").startswith(("0.10.", "0.11.0")):
    # Later versions do not have this flag, and an unknown flag ends the process.
    os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"
# Compiled programs are shared by all test processes, later files, and commands that tests start:
# they use one folder, set before the test processes start. It is also their cache folder, so that
# what a user compiled changes no test.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="compiled", ignore_cleanup_errors=True)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _cache.name)
    os.environ["XDG_CACHE_HOME"] = os.path.abspath(os.environ["JAX_COMPILATION_CACHE_DIR"])
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
# Each run, and each of a hundred processes that tests start, would compile all Python anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import hypothesis
import pytest

from tests import shape_checks
from tests.fuzzing import FACTOR
from tests.layers.selection import layers, matches

shape_checks.use()
sys.dont_write_bytecode = False  # set when this process began, by the variable removed above

# Tracing makes millions of small objects that live long: with Python's own thresholds, garbage
# collection takes up to a tenth of the time and frees next to nothing.
gc.set_threshold(100_000, 20, 100)

# The same examples in every run, so that a failing test fails until it is repaired. No deadline:
# the first example includes compiling. No database: it would only hold the same examples.
hypothesis.settings.register_profile(
    "jaxbeam",
    derandomize=FACTOR == 1,
    deadline=None,
    database=None,
    print_blob=False,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("jaxbeam")


def pytest_addoption(parser):
    parser.addoption(
        "--nightly", action="store_true", help="run the tests of tests/layers/nightly.txt too"
    )


@pytest.hookimpl(tryfirst=True)  # before tests are left out by their marks
def pytest_collection_modifyitems(config, items):
    """Put tests into layers, and files of many slow tests first, so that processes end together.

    A nightly test runs with `--nightly`, or when it is named on the command line.
    """
    named = any("::" in argument for argument in config.args)
    nightly, slow = layers()
    late = (
        []
        if named or config.getoption("nightly")
        else [item for item in items if matches(item.nodeid, nightly)]
    )
    if late:
        config.hook.pytest_deselected(items=late)
        items[:] = [item for item in items if item not in set(late)]
    for item in items:
        if matches(item.nodeid, slow) or matches(item.nodeid, nightly):
            item.add_marker("slow")
    slow = collections.Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


def pytest_collection_finish():
    """Garbage collection passes over what was imported: modules, and the tests themselves."""
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def _sweeps_in_xla():
    """No large sweep of a test compiles the C integrator, which rounds otherwise, for later ones.

    Tests of it have cache folders of their own.
    """
    native_peaks = sys.modules.get("jaxbeam.simulation.integrator.native_peaks")
    if native_peaks:
        native_peaks.LIBRARY.remove()


@pytest.fixture(scope="session")
def native_cache(tmp_path_factory):
    """A cache folder with the C integrator, compiled once for the tests of a process."""
    from jaxbeam.simulation.integrator import native_peaks

    folder = str(tmp_path_factory.mktemp("cache"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", folder)
        native_peaks.LIBRARY.build()
    return folder


@pytest.fixture(scope="module")
def c_integrator(native_cache):
    """The C integrator for a test file that asks for it; the others sweep without."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", native_cache)
        yield


@pytest.fixture(autouse=True)
def _close_figures():
    """Close the figures of a test: matplotlib warns of many open ones, and warnings are errors."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture(autouse=True, scope="module")
def _clear_compiled():
    """Drop the programs of a test file: those of all files would take several gigabytes."""
    yield
    if "jaxbeam.runtime.compiling" in sys.modules:
        sys.modules["jaxbeam.runtime.compiling"].clear_caches()
    elif "jax" in sys.modules:
        sys.modules["jax"].clear_caches()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Cases of tests have numbers of any size: they are judged where that is tested alone."""
    shape_checks.calls.clear()
    from jaxbeam.model.plausibility import check

    judged = "test_plausibility.py", "test_docstrings.py", "test_growth.py"
    check._SHOWN.set(item.path.name not in judged)
