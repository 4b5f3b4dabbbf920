"""Docstrings of prose with `names` in single backticks, and signatures as the source has them."""

import ast
import dataclasses
import inspect
import re
import textwrap

from docutils import nodes
from sphinx import addnodes

import jaxbeam
import tuning

PUBLIC: dict[str, str] = {}
for package in (jaxbeam, tuning):
    for public_name in package.__all__:
        one = getattr(package, public_name)
        if inspect.ismodule(one):
            PUBLIC |= {f"{public_name}.{inner}": package.__name__ for inner in one.__all__}
        else:
            PUBLIC[public_name] = package.__name__


def as_text(line: str) -> str:
    """A line of prose as reStructuredText, with links at the public names in backticks."""
    pieces = line.split("`")
    if len(pieces) % 2 == 0:  # a name that is broken over two lines
        return re.sub(r"([\\*|`]|_\b)", r"\\\1", line)
    for i, piece in enumerate(pieces):
        if i % 2:
            name = piece.removeprefix("jb.").removeprefix("jaxbeam.").removeprefix("tuning.")
            if name in PUBLIC:
                pieces[i] = f":py:obj:`{piece} <{PUBLIC[name]}.{name}>`"
            else:
                pieces[i] = f"``{piece}``"
        else:
            bullet = re.match(r"\s*[-*] ", piece) if i == 0 else None
            start = bullet.end() if bullet else 0
            escaped = re.sub(r"([\\*|]|(?<=\w)_(?!\w))", r"\\\1", piece[start:])
            pieces[i] = piece[:start] + escaped
    return "".join(pieces)


def _rewrite(app, what, name, obj, options, lines):
    """Docstring of `autodoc` in place; the fields of a class follow as a table."""
    text, in_example, in_block = [], False, False
    for line in lines:
        in_example = bool(line.strip()) and (in_example or line.strip().startswith(">>> "))
        in_block = in_block and (not line.strip() or line.startswith("    "))
        if not in_example and not in_block and line.startswith("    "):
            in_block = True  # an equation or a table in plain text
            text += ["::", ""]
        text.append(line if in_example or in_block else as_text(line))
    if what == "class":
        text += ["", *field_table(obj)]
    lines[:] = text


def field_table(one: type) -> list[str]:
    """Table of the fields of a class, with shapes, units, defaults and meanings."""
    by_name = {}  # a class may declare again what its interface leaves open
    for owner in reversed(one.__mro__):
        if owner.__module__.split(".")[0] not in ("jaxbeam", "tuning"):
            continue
        for node in class_body(owner):
            if isinstance(node, ast.AnnAssign) and not ast.unparse(node.annotation).startswith(
                ("ClassVar", "typing.ClassVar")
            ):
                name = ast.unparse(node.target)
                by_name[name] = field_row(one, name, node)
    rows = [row for row in by_name.values() if not row[0].startswith("_")]
    if not rows:
        return []
    lines = [".. list-table::", "   :header-rows: 1", "   :class: fields", ""]
    header = ("field", "meaning", "unit", "type and shape", "default")
    used = [i for i in range(5) if i in (0, 3) or any(row[i] for row in rows)]
    for row in (header, *rows):
        for k, i in enumerate(used):
            cell = f"``{row[i]}``" if row is not header and i in (0, 3, 4) and row[i] else row[i]
            lines.append(("   * - " if k == 0 else "     - ") + cell)
    return lines


def shape(annotation: str) -> str:
    """Type of a field as readers of a table want it: a number, or an array with its axes."""

    def of_array(match):
        axes = match[1].split()
        if not axes:
            return "number"
        if len(axes) == 1 and axes[0].startswith("*"):
            return f"number or ({axes[0][1:]},)"
        return f"({', '.join(axes)}{',' * (len(axes) == 1)})"

    annotation = re.sub(r"^eqx\.AbstractVar\[(.*)\]$", r"\1", annotation)
    text = re.sub(r"(?:Float|Int|Bool|Complex)\[[\w.]+, '([^']*)'\]", of_array, annotation)
    return text.replace(" | None", " or none")


def class_body(one: type) -> list[ast.stmt]:
    """Statements of a class, from its source."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(one)))
    except (TypeError, OSError):
        return []
    return tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []


def field_row(one: type, name: str, node: ast.AnnAssign) -> tuple[str, ...]:
    """Name, meaning, unit, type and default of a field."""
    declared = (
        {field.name: field for field in dataclasses.fields(one)}
        if (dataclasses.is_dataclass(one))
        else {}
    )
    metadata = declared[name].metadata if name in declared else {}
    default = declared[name].default if name in declared else dataclasses.MISSING
    if name not in declared and node.value is not None:
        default = ast.unparse(node.value)
    shown = "" if default in (dataclasses.MISSING, None, "", ()) else str(default)
    unit = metadata.get("unit", "")
    meaning = as_text(metadata.get("meaning", ""))
    return name, meaning, "" if unit == "1" else unit, shape(ast.unparse(node.annotation)), shown


def source_of(function) -> ast.FunctionDef | None:
    """Syntax tree of a function, without what decorators make of it."""
    try:
        source = textwrap.dedent(inspect.getsource(inspect.unwrap(function)))
    except (TypeError, OSError):
        return None
    node = ast.parse(source).body[0]
    return node if isinstance(node, ast.FunctionDef) else None


def _signature(app, what, name, obj, options, signature, returns):
    """Signature as in the source, where shapes and units are readable."""
    if what in ("function", "method", "property"):
        function = getattr(obj, "fget", obj)
        node = source_of(function)
        if node is None:
            return signature, returns
        arguments = node.args
        every = arguments.posonlyargs + arguments.args
        if what != "function" and every and every[0].arg in ("self", "cls"):
            (arguments.posonlyargs or arguments.args).pop(0)
        result = ast.unparse(node.returns) if node.returns else None
        if what == "property":
            return signature, result
        return f"({ast.unparse(arguments)})", result
    if what == "class":
        return "", None  # the table of fields follows
    return signature, returns


def _skip(app, what, name, obj, skip, options):
    """Leave out fields of named tuples, which the table of fields has, with types and meanings."""
    return True if (inspect.getdoc(obj) or "").startswith("Alias for field number") else None


def plain_type(text: str) -> str:
    """Type as in the source, `Float[Array, 'time']`, for what jaxtyping makes of it."""
    array = r"(\w+)\[jaxlib\._jax\.Array, ('[^']*')\]( \| \1\[ndarray, \2\])?( \| generic)?"
    return re.sub(array, r"\1[Array, \2]", text)


def _plain_types(app, doctree):
    """Types of properties as the source has them."""
    for node in doctree.findall(addnodes.desc_annotation):
        text = node.astext()
        if plain_type(text) != text:
            node.children = []
            node += nodes.Text(plain_type(text))


def setup(app):
    """Connect to autodoc."""
    app.connect("autodoc-process-docstring", _rewrite)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-skip-member", _skip)
    app.connect("doctree-read", _plain_types)
    return {"parallel_read_safe": True}
