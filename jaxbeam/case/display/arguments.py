"""Arguments of parts that are missing or unknown, explained in a sentence."""

import dataclasses
from typing import TYPE_CHECKING

import equinox as eqx

from jaxbeam.case.declared_checks import in_unit, suggestion

if TYPE_CHECKING:  # a type checker takes the fields of a module for its arguments
    ExplainsArguments = type
else:

    class ExplainsArguments(type(eqx.Module)):
        """Metaclass of parts whose errors of arguments say what each number is."""

        def __call__(cls, *args, **arguments):
            """Raises TypeError for arguments that are missing or unknown."""
            try:
                return super().__call__(*args, **arguments)
            except TypeError:
                explanation = _explanation(cls, args, arguments)
                if explanation is None:
                    raise
            raise TypeError(explanation)


def _explanation(part_class: type, args: tuple, arguments: dict) -> str | None:
    """Sentence about the first unknown, or all missing arguments; None without any."""
    fields = {field.name: field for field in dataclasses.fields(part_class) if field.init}
    for name in arguments:
        if name not in fields:
            return f"{part_class.__name__} has no {name}; {suggestion(name, fields)}"
    positional = [name for name, field in fields.items() if not field.kw_only]
    given = {*positional[: len(args)], *arguments}
    missing = [
        f"{name}, the {field.metadata['meaning']}{in_unit(field)}"
        for name, field in fields.items()
        if name not in given and _is_required(field)
    ]
    if not missing:
        return None
    return f"{part_class.__name__} lacks {'; '.join(missing)}: give {_them(missing)}"


def _them(missing: list[str]) -> str:
    return "it" if len(missing) == 1 else "them"


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING
