"""Which cores a benchmark runs on; to be said before JAX is imported."""

import os


def one_core() -> None:
    """Have this process run on one core, XLA's threads included."""
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
