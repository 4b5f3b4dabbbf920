"""Equations as MathML, which browsers show without a script: the site reads offline."""

from docutils.nodes import SkipNode
from docutils.utils.math import latex2mathml, pick_math_environment


def equation(latex: str, block: bool) -> str:
    """MathML of an equation in LaTeX, in a line of text or in lines of its own."""
    text = latex.strip()
    if block and not text.startswith(r"\begin"):
        environment = pick_math_environment(text)
        if environment != "equation*":
            text = rf"\begin{{{environment}}}{text}\end{{{environment}}}"
    return latex2mathml.tex2mathml(text.replace("''''", "^{(4)}"), as_block=block)


def _visit_inline(translator, node):
    translator.body.append(equation(node.astext(), block=False))
    raise SkipNode


def _visit_block(translator, node):
    anchors = "".join(f'<span id="{one}"></span>' for one in node["ids"])
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    mathml = equation(node.astext(), block=True)
    translator.body.append(f'<div class="math">{anchors}{number}{mathml}</div>\n')
    raise SkipNode


def setup(app):
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True}
