"""A report as Markdown: its words, tables and code; the pictures are in the HTML file."""

from __future__ import annotations

from herglotz.report.sections import Block, Code, Document, Picture, Slider, Table


def as_markdown(document: Document) -> str:
    """Return the whole text."""
    parts = [f"# {document.title}", f"**{document.verdict.split(':')[0]}.** {document.meaning}", document.verdict]
    for section in document.sections:
        parts += [f"## {section.title}", *filter(None, map(_block, section.blocks))]
    return "\n\n".join(parts) + "\n"


def _block(block: Block) -> str:
    if isinstance(block, Code):
        return f"```\n{block.text}\n```"
    if isinstance(block, Table):
        rows = [block.head, ("---",) * len(block.head), *block.rows]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)
    if isinstance(block, (Picture, Slider)):
        return f"*(picture in the HTML file: {block.caption})*"
    return block
