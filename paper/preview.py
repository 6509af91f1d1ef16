"""Render ``paper/paper.md`` as ``out/paper.pdf``, as a look at the text before it is submitted.

``make preview`` runs it in an environment of its own, which has pandoc and typst. The journal's own
template differs.
"""

import re
from pathlib import Path

import pypandoc
import typst
import yaml

HERE = Path(__file__).parent
OUT = HERE.parent / "out"


def main() -> None:
    """Convert Markdown to Typst, and Typst to PDF."""
    OUT.mkdir(exist_ok=True)
    text = (HERE / "paper.md").read_text()
    # The journal's filters resolve references to figures; here they are numbered in their order.
    labels = re.findall(r"\\label\{(.*?)\}", text)
    for number, label in enumerate(labels, start=1):
        text = text.replace(rf"\autoref{{{label}}}", f"Figure {number}")
        text = text.replace(rf"\label{{{label}}}", "")
    header = yaml.safe_load(text.split("---\n")[1])
    source = pypandoc.convert_text(
        text,
        "typst",
        format="markdown",
        extra_args=[
            "--standalone",
            "--citeproc",
            f"--bibliography={HERE / header['bibliography']}",
            f"--metadata=author:{header['authors'][0]['name']}",
            "--variable=papersize:a4",
            "--variable=fontsize:10pt",
        ],
    )
    path = HERE / "preview.typ"  # beside the figures, whose paths are relative to the paper
    path.write_text(source)
    try:
        typst.compile(path, output=OUT / "paper.pdf", root=HERE.parent)
    finally:
        path.unlink()


if __name__ == "__main__":
    main()
