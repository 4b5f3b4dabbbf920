"""Keyword arguments of former versions, accepted with a warning by controllers and estimators."""

import dataclasses
from typing import TYPE_CHECKING

from jaxbeam.case.aliases import KEYS, warn_renamed
from jaxbeam.case.display.arguments import ExplainsArguments

if TYPE_CHECKING:  # a type checker takes the fields of a module for its arguments
    AcceptsFormerArguments = type
else:

    class AcceptsFormerArguments(ExplainsArguments):
        """Metaclass that replaces former words among the keyword arguments by the present ones."""

        def __call__(cls, *args, **arguments):
            """Raises TypeError if the old and the new word are both given."""
            if KEYS.keys() & arguments.keys():
                arguments = _present(cls, arguments)
            return super().__call__(*args, **arguments)


def _present(part_class: type, arguments: dict) -> dict:
    fields = {field.name for field in dataclasses.fields(part_class)}
    present = {}
    for name, value in arguments.items():
        new = name if name in fields else KEYS.get(name, name)
        if new != name and new in arguments:
            raise TypeError(f"{part_class.__name__}: {name} is called {new} now; leave one out")
        if new != name:
            warn_renamed(f"{part_class.__name__}({name}=...)", new, stacklevel=4)
        present[new] = value
    return present
