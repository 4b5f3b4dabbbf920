"""A chunk of steps by hand-written C (`native.c`), where that was compiled for this machine.

XLA makes of a step some forty small loops over the lanes; by hand it is one. The C is compiled
once, when asked for, by the C compiler of the machine, into the user's cache folder. Sweeps then
use it where they look for peaks alone (not histories), without a controller, in double precision,
on CPUs. Nobody needs it.
"""

import ctypes
import functools
import hashlib
import itertools
import math
import operator
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case
from jaxbeam.exponentials import GAUSS, LOOKED, NODES
from jaxbeam.extremes import NEAR, Extremes
from jaxbeam.kept_programs import cache_folder, machine
from jaxbeam.peaks import CLIMBS, ROUNDINGS, STARTS, VERTEX_ROUNDS, reach, through
from jaxbeam.tables import CHUNK, Path, Rigging

SOURCE = pathlib.Path(__file__).with_suffix(".c")
HEADERS = [SOURCE.with_name(f"native_{name}.h") for name in ("lanes", "peaks", "tables")]
FILL = 8  # numbers that fill whole vector registers of any machine
CONSTANTS = {
    "FILL": FILL,
    "STEPS": CHUNK,
    "NODES": NODES,
    "POINTS": len(LOOKED),
    "NEAR": NEAR,
    "REACH": reach(LOOKED),
    "ROUNDS": VERTEX_ROUNDS,
    "STARTS": STARTS,
    "CLIMBS": CLIMBS,
    "SLACK": ROUNDINGS * sys.float_info.epsilon,
}
FLAGS = (
    *("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC"),
    *(f"-D{name}={value}" for name, value in CONSTANTS.items()),
)
# Deflections that count, by what makes them large.
SIDES = {abs: "both_sides", operator.pos: "one_side"}
PARTS = ("chunk", "places")  # of the work that are done in C


def binary() -> pathlib.Path:
    """Where the compiled C is, or would be: a file for this source, this machine and this JAX."""
    return cache_folder() / f"native-{_mark()}.so"


def compiler() -> str | None:
    """The C compiler of this machine: that named in CC, or cc, gcc or clang, if there is one."""
    found = (shutil.which(name) for name in ("cc", "gcc", "clang"))
    return os.environ.get("CC") or next(filter(None, found), None)


def build() -> pathlib.Path:
    """Compile the C for this machine and return the library's path; sweeps use it from then on.

    Raises RuntimeError without a C compiler, or with what it complains of; OSError if the cache
    folder cannot be written.
    """
    command = compiler()
    if command is None:
        raise RuntimeError("there is no C compiler here: install gcc or clang, or name one in CC")
    target = binary()
    target.parent.mkdir(parents=True, exist_ok=True)
    # Made beside its place and moved there, so that nobody ever loads half of it.
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        made = pathlib.Path(folder) / target.name
        words = [*command.split(), str(SOURCE), *FLAGS, "-I", jax.ffi.include_dir()]
        try:
            done = subprocess.run([*words, "-o", str(made)], capture_output=True, text=True)
        except OSError as error:
            raise RuntimeError(f"the C compiler {command} cannot be run: {error}") from None
        if done.returncode or not made.exists():
            said = done.stderr.strip()[-500:]
            raise RuntimeError(f"the C compiler {command} cannot compile {SOURCE}: {said}")
        _digest(target).write_text(hashlib.sha256(made.read_bytes()).hexdigest())
        os.replace(made, target)
    return target


def remove() -> None:
    """Remove what was compiled for this machine, if it was: sweeps do without again."""
    for path in (binary(), _digest(binary())):
        path.unlink(missing_ok=True)


def serves(case: Case) -> bool:
    """Whether steps of this case, if its peaks are swept, are those in C."""
    return case.controller is None and ready()


def ready() -> bool:
    """Whether the C is compiled for this machine, and of use: computing on a CPU."""
    return jax.default_backend() == "cpu" and _sound(binary()) and bool(_library())


def _sound(path: pathlib.Path) -> bool:
    """Whether there is a library, undamaged: to load one that is not would end the process."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == _digest(path).read_text()
    except OSError:
        return False


@functools.cache
def _library() -> ctypes.CDLL:
    """The library, of which XLA is told; it takes each name once in a process."""
    loaded = ctypes.CDLL(str(binary()))
    loaded.chunk_room.restype = ctypes.c_int64
    for part, size in itertools.product(PARTS, SIDES):
        function = getattr(loaded, f"{part}_of_{SIDES[size]}")
        jax.ffi.register_ffi_target(_target(part, size), jax.ffi.pycapsule(function))
    return loaded


def _digest(path: pathlib.Path) -> pathlib.Path:
    """Where the check value of a library is."""
    return path.with_suffix(".sha256")


def _target(part: str, size: Callable) -> str:
    """The name under which XLA knows a function of the library."""
    return f"jaxbeam_{part}_of_{SIDES[size]}_{_mark()}"


@functools.cache
def _mark() -> str:
    """A number for the source, the machine and JAX."""
    written = [path.read_text() for path in (SOURCE, *HEADERS)]
    marks = [*written, *FLAGS, jax.__version__, machine()]
    return hashlib.sha256("\n".join(marks).encode()).hexdigest()[:16]


def prepare(rigging: Rigging) -> tuple:
    """The propagators as `chunk` takes them."""
    step = rigging.step
    return (
        _last(step.drift_nodes, 1),
        _last(step.push_nodes, 2),
        step.drift_end.swapaxes(-1, -2),
        _last(step.push_end, 1),
        jnp.moveaxis(rigging.watch, 1, -1),
        _last(rigging.watch_push, 1),
    )


def _last(part, axis: int):
    """With an axis as the last, padded to fill registers."""
    part = jnp.moveaxis(part, axis, -1)
    return jnp.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, -part.shape[-1] % FILL)])


@jax.named_scope("native")
def chunk(
    prepared: tuple,
    path: Path,
    inertia: Float[Array, "load lane"],
    weight: Float[Array, "load lane"],
    state: Float[Array, "state lane"],
    best: Extremes,
) -> tuple[Float[Array, "state lane"], Extremes]:
    """The state after a chunk of steps, and the extremes so far, from those before it.

    Steps without commands of a driver, in double precision; only if `ready`. `prepared` is what
    `prepare` makes of the rigging.
    """
    changed = state, *jax.tree.leaves(best)
    shape, rows = _last(path.shape, 2), _last(path.rows, 2)
    given = (
        *(*prepared, path.kind, path.start, path.span, path.slots, path.active, shape, rows),
        *(inertia, weight, np.asarray(GAUSS), through(LOOKED)[: len(LOOKED)].T, np.asarray(LOOKED)),
    )
    room = _library().chunk_room(state.shape[0], path.slots.shape[1], best.score.shape[0])
    call = jax.ffi.ffi_call(
        _target("chunk", best.size),
        [jax.ShapeDtypeStruct(part.shape, part.dtype) for part in (*changed, np.empty(room))],
        vmap_method="sequential",
        input_output_aliases={len(given) + i: i for i in range(len(changed))},
    )
    state, *leaves, _ = call(*given, *changed)
    return state, jax.tree.unflatten(jax.tree.structure(best), leaves)


@jax.named_scope("native")
def find(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], size: Callable
) -> Float[Array, " *rest"]:
    """What `peaks.find` finds, of samples at the points of a step that are looked at."""
    rest = samples.shape[1:]
    call = jax.ffi.ffi_call(
        _target("places", size),
        jax.ShapeDtypeStruct((math.prod(rest),), samples.dtype),
        vmap_method="sequential",
    )
    return call(samples.reshape(len(points), -1), through(points)[: len(points)].T).reshape(rest)
