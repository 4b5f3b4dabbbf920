"""Old names of public functions, keyword arguments and attributes; each works, with a warning."""

import functools
from collections.abc import Callable, Mapping
from typing import TypeVar, cast

from jaxbeam.case.aliases import renamed_property, warn_renamed

Target = TypeVar("Target", bound=Callable)
Class = TypeVar("Class", bound=type)

# Old name in the package `tuning`: the name that replaced it.
OLD_NAMES = {
    "Belief": "Prior",
    "Stable": "StabilityConstraint",
    "Tuned": "TuningResult",
    "adopt": "with_identified_plant",
    "draws": "latin_hypercube",
    "grid": "full_grid",
    "hold_out": "predict_held_out",
    "sharpen": "design_experiment",
    "tune_choices": "tune_integers",
}


def accepts_old_arguments(**new_names: str) -> Callable[[Target], Target]:
    """Decorator for a function, or a class, that takes old keyword arguments as well.

    `new_names` gives the keyword argument that replaced each old one. A call with both an old and
    its new argument is refused: it raises TypeError.
    """

    def _decorated(target: Target) -> Target:
        function = target.__init__ if isinstance(target, type) else target

        @functools.wraps(function)
        def _with_old_arguments(*given, **options):
            for old in new_names.keys() & options.keys():
                new = new_names[old]
                if new in options:
                    raise TypeError(f"{old} is called {new} now: give one of them, not both")
                warn_renamed(f"the argument {old} of {target.__name__}", new)
                options[new] = options.pop(old)
            return function(*given, **options)

        if not isinstance(target, type):
            return cast(Target, _with_old_arguments)
        target.__init__ = _with_old_arguments
        return cast(Target, target)

    return _decorated


def has_old_attributes(**new_names: str) -> Callable[[Class], Class]:
    """Decorator for a class with old attributes; `new_names` gives those that replaced them."""

    def decorate(target: Class) -> Class:
        for old, new in new_names.items():
            setattr(target, old, renamed_property(old, new))
        return target

    return decorate


def current_word(word: str, new_words: Mapping[str, str], what: str) -> str:
    """The word, or the one that replaced it, with a warning; `what` says what it is for."""
    if word not in new_words:
        return word
    warn_renamed(f"{what} {word!r}", repr(new_words[word]), stacklevel=4)
    return new_words[word]
