"""Serve Plotly from the site itself, so that charts in notebooks need no other server."""

import re
from pathlib import Path

from plotly.offline import get_plotlyjs
from sphinx.application import Sphinx

ELSEWHERE = re.compile(r'<script[^>]*src="https://cdn.plot.ly/[^"]*"[^>]*>')
LOCAL = '<script src="../_static/plotly.min.js">'


def localise(app: Sphinx, exception: Exception | None) -> None:
    """Replace the address of Plotly in the built notebooks."""
    if exception is not None:
        return
    (Path(app.outdir) / "_static/plotly.min.js").write_text(get_plotlyjs(), encoding="utf-8")
    for page in Path(app.outdir, "notebooks").glob("*.html"):
        page.write_text(ELSEWHERE.sub(LOCAL, page.read_text(encoding="utf-8")), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("build-finished", localise)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
