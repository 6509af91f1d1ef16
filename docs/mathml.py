r"""Formulas as MathML, which browsers draw themselves: no page needs a script of another server.

A formula that cannot be converted is a warning, which fails `make docs`.
"""

from html import escape

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

LOG = logging.getLogger(__name__)
CONVERTER = LatexToMathML(fancy_error=False)


def markup(node: nodes.Element, *, displayed: bool) -> str:
    """The MathML of a formula; with a warning its source, if there is none."""
    source = node.astext().strip()
    if (
        r"\\" in source and r"\begin" not in source
    ):  # lines, as Sphinx has them in all formats
        source = rf"\begin{{aligned}}{source}\end{{aligned}}"
    try:
        return CONVERTER.convert_with_local_state(
            source, displaystyle=displayed
        )
    except LatexError as error:
        LOG.warning("no MathML of %s: %s", source, error, location=node)
        return f"<code>{escape(source)}</code>"


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(markup(node, displayed=False))
    raise nodes.SkipNode


def visit_math_block(
    translator: HTML5Translator, node: nodes.math_block
) -> None:
    formula = markup(node, displayed=True)
    translator.body.append(f'<div class="math">{formula}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer(
        "mathml", (visit_math, None), (visit_math_block, None)
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
