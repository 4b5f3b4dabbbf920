"""Old names of public functions, keyword arguments and words; each works, with a warning."""

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import TypeVar, cast

Target = TypeVar("Target", bound=Callable)

# Old name in the package `tuning`: the name that took its place.
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


def warn_of_old_name(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that a name is out of use, and which one took its place."""
    warnings.warn(f"{old} is now called {new}", DeprecationWarning, stacklevel=stacklevel)


def accepts_old_arguments(**new_names: str) -> Callable[[Target], Target]:
    """Decorator for a function, or a class, that takes old keyword arguments as well.

    `new_names` gives the keyword argument that took the place of each old one.
    """

    def decorate(target: Target) -> Target:
        function = target.__init__ if isinstance(target, type) else target

        @functools.wraps(function)
        def with_old_arguments(*given, **options):
            for old in new_names.keys() & options.keys():
                new = new_names[old]
                if new in options:
                    raise TypeError(f"{old} is now called {new}: give one of them, not both")
                warn_of_old_name(f"the argument {old} of {target.__name__}", new)
                options[new] = options.pop(old)
            return function(*given, **options)

        if not isinstance(target, type):
            return cast(Target, with_old_arguments)
        target.__init__ = with_old_arguments
        return cast(Target, target)

    return decorate


def current_word(word: str, new_words: Mapping[str, str], what: str) -> str:
    """The word, or the one that took its place, with a warning; `what` says what it is for."""
    if word not in new_words:
        return word
    warn_of_old_name(f"{what} {word!r}", repr(new_words[word]), stacklevel=4)
    return new_words[word]
