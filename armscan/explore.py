"""The command `python -m armscan.explore`: a window in which a person moves the plane by sliders.

    python -m armscan.explore                 phantom wrists
    python -m armscan.explore data=FOLDER     the volumes of a folder, whether they have a labelled plane or not

data=FOLDER         the volumes, with a manifest or without
volume=NAME         the volume to begin with
clustering=metric   cluster what is seen by millimetres, for volumes of another spacing than about 0.27 x 0.55 mm

In a notebook: %matplotlib widget, then armscan.explore.explore(volume).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from armscan.exploring import Explorer, explore
from armscan.words import answered, read_words

__all__ = ["Explorer", "explore", "main"]

KEYS = ("data", "volume", "clustering")


def main(words: Sequence[str] | None = None) -> int:
    """Runs what the command line asks for, until the window is closed; returns the exit code."""
    return answered(_run, words, usage=__doc__ or "", left="nothing is written")


def _run(words: Sequence[str]) -> int:
    values = read_words(words, KEYS, texts=KEYS)
    explore(values.get("data"), volume=values.get("volume"), clustering=values.get("clustering", "pixels"))
    from matplotlib import pyplot

    pyplot.show()
    return 0


if __name__ == "__main__":
    sys.exit(main())
