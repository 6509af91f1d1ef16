"""The directive ``picture-of``: the figure that a cell of another page draws.

The notebook marks that cell with the tag ``gallery``. The picture is the one that the build has just
drawn, so a gallery needs no image files and shows what its pages show.
"""

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.logging import getLogger

LOGGER = getLogger(__name__)


class PictureOf(nodes.Element):
    """Stands for the picture until all pages are read."""


class PictureOfDirective(SphinxDirective):
    """``picture-of`` with the name of a page, and the picture in words as its content."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Leave a place for the picture."""
        node = PictureOf(page=self.arguments[0], alt=" ".join(self.content))
        self.set_source_info(node)
        return [node]


def _put_pictures(app: Sphinx, doctree: nodes.document, docname: str) -> None:
    for place in list(doctree.findall(PictureOf)):
        image = _drawn(app.env.get_doctree(place["page"]))
        if image is None and app.config.nb_execution_mode != "off":
            LOGGER.warning(
                "no cell with the tag 'gallery' in %s draws a picture",
                place["page"],
                location=place,
            )
        place.replace_self(
            [] if image is None else _with_text(image, place["alt"])
        )


def _drawn(page: nodes.document) -> nodes.image | None:
    """Return the first picture of the tagged cell."""
    for cell in page.findall(nodes.container):
        if "tag_gallery" in cell["classes"]:
            return next(cell.findall(nodes.image), None)
    return None


def _with_text(image: nodes.image, alt: str) -> nodes.image:
    picture = image.deepcopy()
    picture["alt"] = alt
    picture["classes"] = ["gallery"]
    return picture


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_node(PictureOf)
    app.add_directive("picture-of", PictureOfDirective)
    app.connect("doctree-resolved", _put_pictures)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
