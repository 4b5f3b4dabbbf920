"""Equations as pictures in the page: no script, no font of the reader's, and they read offline."""

import html

import ziamath
from docutils.nodes import SkipNode

ziamath.config.math.color = "currentColor"  # that of the text, in dark mode too
SIZE = 17  # px
MAX_HEIGHT = 8 * SIZE  # higher: a bracket around a sum, by \left and \right, was set wrongly


def equation(latex: str, block: bool) -> str:
    """SVG of an equation in LaTeX, in a line of text or in a line of its own.

    Raises ValueError for LaTeX that cannot be set.
    """
    try:
        picture = ziamath.Latex(latex.strip(), size=SIZE, inline=not block)
        svg = picture.svg()
    except Exception as error:
        raise ValueError(f"cannot set the equation {latex.strip()}: {error!r}") from error
    if picture.getsize()[1] > MAX_HEIGHT:
        raise ValueError(f"set too high, take \\Bigl and \\Bigr: {latex.strip()}")
    label = html.escape(" ".join(latex.split()))
    look = "" if block else f' style="vertical-align:{picture.getyofst():.1f}px"'
    return svg.replace("<svg ", f'<svg role="img" aria-label="{label}" class="equation"{look} ', 1)


def _visit_inline(translator, node):
    translator.body.append(equation(node.astext(), block=False))
    raise SkipNode


def _visit_block(translator, node):
    anchors = "".join(f'<span id="{one}"></span>' for one in node["ids"])
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    svg = equation(node.astext(), block=True)
    translator.body.append(f'<div class="math">{anchors}{number}{svg}</div>\n')
    raise SkipNode


def setup(app):
    """Register the renderer."""
    app.add_html_math_renderer("svg", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True}
