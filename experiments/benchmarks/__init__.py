"""Timings against other solvers: each table from one command, by a written method."""

import os


def use_one_core() -> None:
    """Run this process, XLA's threads included, on one core; to be called before importing JAX."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
