"""Serve Plotly from the site itself, so that charts in notebooks need no other server."""

import re
from pathlib import Path

from plotly.offline import get_plotlyjs
from sphinx.application import Sphinx

PLOTLY = re.compile(r'<script[^>]*src="https://cdn\.plot\.ly/[^"]*"[^>]*>')
LOCAL = '<script src="../_static/plotly.min.js">'
# Plotly as a module, which nothing here imports, and MathJax, because no chart has a formula.
UNUSED = re.compile(
    r'<script type="module">import "https://cdn\.plot\.ly/[^<]*</script>'
    r'|<script[^>]*src="https://cdnjs\.cloudflare\.com/ajax/libs/mathjax/[^>]*></script>'
)


def from_this_site(page: str) -> str:
    """Make a page with charts load Plotly from this site, and nothing from elsewhere."""
    return PLOTLY.sub(LOCAL, UNUSED.sub("", page))


def localise(app: Sphinx, exception: Exception | None) -> None:
    """Write Plotly into the site, and make the built notebooks load it from there."""
    if exception is not None:
        return
    (Path(app.outdir) / "_static/plotly.min.js").write_text(get_plotlyjs(), encoding="utf-8")
    for page in Path(app.outdir, "notebooks").glob("*.html"):
        page.write_text(from_this_site(page.read_text(encoding="utf-8")), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the hook."""
    app.connect("build-finished", localise)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
