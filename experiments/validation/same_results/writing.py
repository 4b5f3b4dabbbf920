"""Results of all cases, written to one file."""

import concurrent.futures
import functools
import importlib
import inspect
import multiprocessing
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.validation.same_results.checkout import import_from_checkout

MODULES = ("uncontrolled_runs", "closed_loops", "sweeps", "fits", "analyses")
# Started first, so that no process is left with one of them at the end.
LONG = ("tuned_gain", "fit_to_logs", "comparison_of_controllers", "load_identification")


def cases() -> dict[str, Callable[[], dict[str, np.ndarray]]]:
    """Functions that compute the arrays of a case, by name: all public ones of MODULES."""
    functions_by_name = {}
    for name in MODULES:
        module = importlib.import_module(f"experiments.validation.same_results.{name}")
        functions = inspect.getmembers(module, inspect.isfunction)
        functions_by_name |= {k: f for k, f in functions if f.__module__ == module.__name__}
    return functions_by_name


def run_case(name: str) -> tuple[dict[str, np.ndarray], float]:
    """Arrays of one case under their full names, and the wall time (s)."""
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = cases()[name]()
    arrays = {f"{name}/{key}": np.asarray(array) for key, array in results.items()}
    return arrays, time.perf_counter() - start


def write(path: Path, names: list[str], jobs: int, checkout: Path | None = None) -> None:
    """Run cases in parallel and write all their arrays to one file.

    A case that fails is named and left out. Raises SystemExit at the end if one has failed.
    """
    arrays: dict[str, np.ndarray] = {}
    failed: list[str] = []
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as cache:
        # Inherited by the worker processes: programs compiled earlier are not used.
        os.environ["XDG_CACHE_HOME"] = cache
        os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
        os.environ["JAX_PLATFORMS"] = "cpu"
        pool = concurrent.futures.ProcessPoolExecutor(
            jobs,
            multiprocessing.get_context("spawn"),
            functools.partial(import_from_checkout, checkout),
        )
        with pool:
            order = sorted(names, key=lambda name: name not in LONG)
            futures = {pool.submit(run_case, name): name for name in order}
            for future in concurrent.futures.as_completed(futures):
                name = futures[future]
                if (error := future.exception()) is not None:
                    failed.append(name)
                    print(f"{name:34} FAILED: {type(error).__name__}: {error}", flush=True)
                    continue
                results, seconds = future.result()
                arrays |= results
                size = sum(array.size for array in results.values())
                counts = f"{len(results):4} arrays {size:8} numbers {seconds:6.1f} s"
                print(f"{name:34} {counts}", flush=True)
    np.savez_compressed(path, **dict(sorted(arrays.items())))
    print(f"written: {path}; {time.perf_counter() - start:.0f} s in all")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")
