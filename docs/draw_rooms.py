"""Draw the packages and their imports to docs/rooms.svg: `python -m docs.draw_rooms`.

A package stands below all that it imports; an arc leads up to an imported package, except where a
chain of other arcs leads there too. The picture carries the text that it shows, by which a test
finds that it is out of date.
"""

import ast
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure
from matplotlib.patches import Arc

from jaxbeam.plot.style import COLOURS, INK, use_style
from tests.test_imports import FILES, RANKS, imports, package

PICTURE = Path(__file__).with_name("rooms.svg")
COLOUR = {"jaxbeam": COLOURS[0], "tuning": COLOURS[2], "experiments": COLOURS[1]}
ROW_HEIGHT = 0.27  # inches
ARC_WIDTH = 0.23  # of its height

Graph = dict[str, set[str]]


def package_imports() -> Graph:
    """Imported packages of every package, the packages from the first to the last level."""
    packages = [name for name in RANKS if f"{name}.__init__" in FILES]
    found: Graph = {name: set() for name in sorted(packages, key=lambda name: RANKS[name])}
    for module, imported in imports().items():
        if package(module) in found:
            found[package(module)] |= {package(name) for name in imported} & found.keys()
    return {name: imported - {name} for name, imported in found.items()}


def description(name: str) -> str:
    """First line of the docstring of a package."""
    text = FILES[f"{name}.__init__"].read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0].replace("`", "")


def listing(imports: Graph) -> str:
    """Packages with their descriptions and imports, a line each."""
    return "\n".join(
        f"{name}: {description(name)} Imports: {', '.join(sorted(imported)) or 'none'}."
        for name, imported in imports.items()
    )


def reduced(imports: Graph) -> Graph:
    """Imports that no chain of other imports implies (transitive reduction)."""

    def reachable(name: str) -> set[str]:
        return imports[name].union(*map(reachable, imports[name]))

    return {
        name: imported - set().union(*map(reachable, imported))
        for name, imported in imports.items()
    }


@use_style
def draw(imports: Graph) -> Figure:
    """Figure of the packages in the order of their levels, arcs at the left for imports."""
    rows = {name: row for row, name in enumerate(imports)}
    arrows = reduced(imports)
    longest = max(rows[name] - rows[other] for name in arrows for other in arrows[name])
    figure = Figure(figsize=(10.5, ROW_HEIGHT * (len(rows) + 0.5)), layout="none")
    axes = figure.add_axes((0, 0, 1, 1))
    width = figure.get_figwidth() / ROW_HEIGHT  # in rows, so that both axes have one scale
    axes.set(xlim=(-0.5 - ARC_WIDTH * longest, width - 0.5 - ARC_WIDTH * longest))
    axes.set(ylim=(len(rows) - 0.25, -0.75))
    axes.axis("off")
    for name, row in rows.items():
        tint = COLOUR[name.split(".")[0]]
        axes.text(0.6, row, name, va="center", color=tint, weight="bold")
        axes.text(8.2, row, description(name), va="center", color=INK)
        axes.plot([0.25], [row], "o", color=tint, markersize=4)
        for other in sorted(arrows[name]):
            height = row - rows[other]
            axes.add_patch(
                Arc(
                    (0.1, (row + rows[other]) / 2),
                    2 * ARC_WIDTH * height,
                    height,
                    theta1=90,
                    theta2=270,
                    color=tint,
                    linewidth=0.9,
                )
            )
    return figure


def main() -> None:
    """Write the picture; the same imports give the same bytes."""
    matplotlib.rcParams |= {"svg.hashsalt": "rooms", "svg.fonttype": "none"}
    imports = package_imports()
    draw(imports).savefig(PICTURE, metadata={"Description": listing(imports), "Date": None})


if __name__ == "__main__":
    main()
