"""Stand-ins for JAX and Equinox where they are not installed: NumPy reads, checks and simulates.

So `jaxbeam` works in a place that has NumPy alone, such as a browser. What must be compiled or
differentiated raises ImportError, with what is missing. `jaxbeam/__init__.py` takes them if there
is no `jax`; nothing here is used where there is one.
"""

import abc
import dataclasses
import functools
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import numpy as np

MISSING = "{} needs JAX, which is not installed: pip install jax equinox optax"


class NoArray:
    """The class of arrays of JAX, of which there are none."""


class NoTracer(NoArray):
    """The class of traced numbers, of which there are none."""


class NoError(Exception):
    """An error that JAX would raise, and NumPy does not."""


class Missing:
    """Stand-in for a function that only JAX has: it can decorate, but not compute."""

    def __init__(self, name: str):
        self.__name__ = self.__qualname__ = name

    def __getattr__(self, name: str) -> "Missing":
        if name.startswith("__"):
            raise AttributeError(name)
        return Missing(f"{self.__name__}.{name}")

    def __call__(self, *args: Any, **options: Any) -> "Missing":
        if not args or callable(args[0]):  # of a function, which may never be called
            return Missing(getattr(args[0], "__name__", "it") if args else self.__name__)
        raise ImportError(MISSING.format(self.__name__))


def _unchanged(function: Any = None, *args: Any, **options: Any) -> Any:
    """A decorator whose function is used as it stands, as `jax.named_scope` of a name."""
    return function if callable(function) else _unchanged


# Trees: modules, tuples, lists and dicts; all else is a leaf, None an empty tree.


@dataclasses.dataclass(frozen=True)
class Structure:
    """A tree without its leaves: kind of its node, names and structures of its parts."""

    kind: Any
    names: tuple[str, ...] = ()
    parts: tuple["Structure", ...] = ()
    static: tuple[tuple[str, Any], ...] = ()

    @property
    def num_leaves(self) -> int:
        """Number of leaves."""
        return 1 if self.kind is NoArray else sum(part.num_leaves for part in self.parts)

    def unflatten(self, leaves: Any) -> Any:
        """The tree with some leaves."""
        return self._build(iter(leaves))

    def _build(self, leaves: Iterator[Any]) -> Any:
        if self.kind is NoArray:
            return next(leaves)
        if self.kind is type(None):
            return None
        return _node(self, [part._build(leaves) for part in self.parts])


_LEAF = Structure(NoArray)


def _node(structure: Structure, parts: list[Any]) -> Any:
    """A node of a kind with other parts."""
    kind = structure.kind
    if kind is dict:
        return dict(zip(structure.names, parts, strict=True))
    if kind in (list, tuple):
        return kind(parts)
    if issubclass(kind, tuple):
        return kind(*parts)
    made = object.__new__(kind)
    for name, value in (*zip(structure.names, parts, strict=True), *structure.static):
        object.__setattr__(made, name, value)
    return made


def _parts(tree: Any) -> tuple[Structure, tuple[Any, ...]] | None:
    """Kind and parts of a node; None for a leaf."""
    kind = type(tree)
    if tree is None:
        return Structure(kind), ()
    if kind is dict:
        names = tuple(sorted(tree))
        return Structure(dict, names), tuple(tree[name] for name in names)
    if isinstance(tree, list | tuple):
        return Structure(kind), tuple(tree)
    if isinstance(tree, TreeModule):
        own = [field for field in dataclasses.fields(kind) if hasattr(tree, field.name)]
        static = [field.name for field in own if field.metadata.get("static")]
        names = tuple(field.name for field in own if field.name not in static)
        kept = tuple((name, getattr(tree, name)) for name in static)
        return Structure(kind, names, (), kept), tuple(getattr(tree, name) for name in names)
    return None


def tree_flatten(tree: Any, is_leaf: Callable | None = None) -> tuple[list[Any], Structure]:
    """`jax.tree.flatten`."""
    leaves = []

    def structure(node):
        found = None if is_leaf is not None and is_leaf(node) else _parts(node)
        if found is None:
            leaves.append(node)
            return _LEAF
        return dataclasses.replace(found[0], parts=tuple(map(structure, found[1])))

    made = structure(tree)
    return leaves, made


def tree_leaves(tree: Any, is_leaf: Callable | None = None) -> list[Any]:
    """`jax.tree.leaves`."""
    return tree_flatten(tree, is_leaf)[0]


def tree_map(function: Callable, tree: Any, *others: Any, is_leaf: Callable | None = None) -> Any:
    """`jax.tree.map`; others may go on below the leaves of the first."""
    leaves, structure = tree_flatten(tree, is_leaf)
    columns = [_below(structure, other) for other in others]
    return structure.unflatten(map(function, leaves, *columns))


def _below(structure: Structure, tree: Any) -> list[Any]:
    """Subtrees of a tree at the places of the leaves of a structure."""
    if structure.kind is NoArray:
        return [tree]
    found = _parts(tree)
    if found is None or len(found[1]) != len(structure.parts):
        raise ValueError(f"a tree of {structure.kind} has no counterpart in {type(tree)}")
    pairs = zip(structure.parts, found[1], strict=True)
    return [leaf for part, own in pairs for leaf in _below(part, own)]


def tree_leaves_with_path(tree: Any, is_leaf: Callable | None = None) -> list[tuple[tuple, Any]]:
    """`jax.tree_util.tree_leaves_with_path`; a path is the names and indices on the way."""
    found = None if is_leaf is not None and is_leaf(tree) else _parts(tree)
    if found is None:
        return [((), tree)]
    names = found[0].names or range(len(found[1]))
    pairs = zip(names, found[1], strict=True)
    return [
        ((name, *path), leaf)
        for name, part in pairs
        for path, leaf in tree_leaves_with_path(part, is_leaf)
    ]


# Equinox.

_T = TypeVar("_T")


class AbstractVar(Generic[_T]):
    """`equinox.AbstractVar`, an annotation."""


class ModuleMeta(abc.ABCMeta):
    """Makes classes frozen dataclasses with converters, as Equinox does."""

    def __new__(mcs, name, bases, namespace, **options):
        """A class; its own constructor, or an inherited one, stays."""
        annotations = namespace.get("__annotations__", {})
        for key in [key for key, kind in annotations.items() if "AbstractVar" in str(kind)]:
            del annotations[key]
        made = super().__new__(mcs, name, bases, namespace, **options)
        above = (kls.__dict__.get("has_own_init") for kls in made.__mro__[1:])
        inherited = next((own for own in above if own is not None), False)
        made.has_own_init = "__init__" in namespace or inherited
        return dataclasses.dataclass(eq=False, repr=False, init=not made.has_own_init)(made)

    def __call__(cls, *args, **options):
        """An object, converted and checked, which does not change from now on."""
        made = super().__call__(*args, **options)
        for field in dataclasses.fields(cls):
            if (convert := field.metadata.get("converter")) is not None:
                object.__setattr__(made, field.name, convert(getattr(made, field.name)))
        for kls in cls.__mro__:
            if "__check_init__" in kls.__dict__:
                kls.__check_init__(made)
        return made


class TreeModule(metaclass=ModuleMeta):
    """`equinox.Module`."""

    def __hash__(self):
        return hash(tuple(tree_leaves(self)))

    def __eq__(self, other):
        return tree_equal(self, other)


def field(*, converter=None, static=False, metadata=None, **options) -> Any:
    """`equinox.field`."""
    own = dict(metadata or {})
    own |= {"converter": converter} if converter is not None else {}
    own |= {"static": True} if static else {}
    return dataclasses.field(metadata=own, **options)


def tree_equal(first: Any, second: Any) -> bool:
    """`equinox.tree_equal`."""
    (a, structure), (b, other) = tree_flatten(first), tree_flatten(second)
    return structure == other and all(map(np.array_equal, a, b))


def is_array(value: Any) -> bool:
    """`equinox.is_array`: no value is one of JAX."""
    return False


class _Mark:
    """A leaf of a tree in which parts are sought, each another object."""

    def __init__(self, leaf: Any):
        self.leaf = leaf


def tree_at(where: Callable, tree: Any, replace: Any = None, is_leaf: Any = None) -> Any:
    """`equinox.tree_at`; parts may be None, whatever `is_leaf` says."""
    leaves, structure = tree_flatten(tree, lambda node: node is None)
    marked = structure.unflatten(map(_Mark, leaves))
    chosen = where(marked)
    nodes = [chosen] if _is_within(marked, chosen) else list(chosen)
    values = [replace] if _is_within(marked, chosen) else list(replace)

    def build(node):
        for one, value in zip(nodes, values, strict=True):
            if node is one:
                return value
        if isinstance(node, _Mark):
            return node.leaf
        found = _parts(node)
        return node if found is None else _node(found[0], [build(part) for part in found[1]])

    return build(marked)


def _is_within(tree: Any, node: Any) -> bool:
    """Whether a node is a tree, or any of its parts."""
    found = _parts(tree)
    return tree is node or (found is not None and any(_is_within(one, node) for one in found[1]))


# The modules.


class _Decorated:
    """A function with rules of derivatives or batches that nothing here asks for."""

    def __init__(self, function: Callable, *args: Any, **options: Any):
        functools.update_wrapper(self, function)
        self.function = function

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self.function(*args, **options)

    def __get__(self, instance: Any, owner: Any) -> Any:
        return self if instance is None else types.MethodType(self, instance)

    defjvp = def_vmap = staticmethod(lambda rule: rule)


class _Module(types.ModuleType):
    """A module that has some functions, and else names what is missing."""

    def __init__(self, name: str, known: dict[str, Any], other: Callable[[str], Any] = Missing):
        super().__init__(name)
        self.__spec__ = importlib.machinery.ModuleSpec(name, None)
        self.__path__ = []
        self._other = other
        self.__dict__.update(known)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._other(f"{self.__name__}.{name}")


class _Finder(importlib.abc.MetaPathFinder):
    """Finder that raises an error with the missing package where another module is imported."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> None:
        """Raises ImportError for a module of JAX, equinox or optax."""
        if fullname.split(".")[0] in ("jax", "jaxlib", "equinox", "optax"):
            raise ImportError(MISSING.format(fullname))


class _Config:
    """Settings of JAX, which nothing reads."""

    values: dict[str, Any] = {}
    jax_enable_x64 = True
    jax_compilation_cache_dir = None
    jax_enable_compilation_cache = False

    def update(self, name: str, value: Any) -> None:
        """Ignore a setting."""


def install() -> None:
    """Take the stand-ins for the modules `jax` and `equinox`."""
    tree = {
        "flatten": tree_flatten,
        "leaves": tree_leaves,
        "map": tree_map,
        "structure": lambda tree: tree_flatten(tree)[1],
        "unflatten": lambda structure, leaves: structure.unflatten(leaves),
        "leaves_with_path": tree_leaves_with_path,
    }
    of_tree = {f"tree_{name}": function for name, function in tree.items()}
    core = {"Tracer": NoTracer, "concrete_or_error": lambda kind, value, context="": value}
    parts = {
        "numpy": _Module(
            "jax.numpy", {}, lambda name: getattr(np, name.split(".")[-1], Missing(name))
        ),
        "tree": _Module("jax.tree", tree),
        "tree_util": _Module("jax.tree_util", of_tree),
        "core": _Module("jax.core", core),
        "errors": _Module("jax.errors", {}, lambda name: NoError),
        "dtypes": np,
    }
    for name in ("lax", "scipy", "extend", "flatten_util", "custom_batching", "stages"):
        parts[name] = _Module(f"jax.{name}", {})
    parts["extend"].core = parts["core"]
    parts["custom_batching"].custom_vmap = _Decorated
    jax = {
        "Array": NoArray,
        "config": _Config(),
        "custom_jvp": _Decorated,
        "named_scope": _unchanged,
        "checkpoint": _unchanged,
        "default_backend": lambda: "cpu",
        **parts,
    }
    experimental = {"serialize_executable": Missing("serialize_executable")}
    modules = {f"jax.{name}": part for name, part in parts.items()}
    modules |= {
        "jax": _Module("jax", jax),
        "jax.experimental": _Module("jax.experimental", experimental),
        "jax.extend.core": parts["core"],
    }
    own = (AbstractVar, TreeModule, field, tree_at, tree_equal, is_array)
    sys.meta_path.insert(0, _Finder())
    sys.modules |= modules | {
        "equinox": _Module("equinox", {one.__name__: one for one in own} | {"Module": TreeModule})
    }
