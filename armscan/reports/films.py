"""Films of episodes side by side, started together."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

from armscan.reports.groups import Group
from armscan.reports.trainings import Training

# An animated picture starts when it is first shown, and is the same wherever its address is: each start has new ones.
PROGRAM = """
<script>
(() => {
  const films = [...document.querySelectorAll(".films img")];
  const contents = films.map((film) => Uint8Array.from(atob(film.dataset.film), (letter) => letter.charCodeAt(0)));
  const start = () => films.forEach((film, number) => {
    URL.revokeObjectURL(film.src);
    film.src = URL.createObjectURL(new Blob([contents[number]], {type: "image/gif"}));
  });
  document.querySelector("#start").addEventListener("click", start);
  new IntersectionObserver((seen, observer) => {
    if (seen.some((each) => each.isIntersecting)) { observer.disconnect(); start(); }
  }).observe(document.querySelector(".films"));
})();
</script>
"""


def films(groups: Sequence[Group]) -> str:
    """Returns a film of each group that has one, of its median training."""
    chosen = [(group, training) for group in groups if (training := _median(group)) is not None]
    if not chosen:
        return "<h2>Episodes</h2><p>None of these runs has kept a film.</p>"
    return (
        "<h2>Episodes</h2><p>On the first test volume, of the training in the middle of its group by mean steps on the "
        "test volumes (of an even number, the better of two). The same seed and volume is the same episode. "
        '<button id="start">start together</button></p>'
        f'<div class="films">{"".join(_figure(*each) for each in chosen)}</div>{PROGRAM}'
    )


def _median(group: Group) -> Training | None:
    """Returns the training in the middle of those with a film; one that was not judged only where none was."""
    filmed = [training for training in group.trainings if training.film is not None]
    ranked = sorted((each for each in filmed if each.evaluation), key=_mean_steps) or filmed
    return ranked[(len(ranked) - 1) // 2] if ranked else None


def _mean_steps(training: Training) -> float:
    return training.evaluation.mean_steps if training.evaluation else 0.0


def _figure(group: Group, training: Training) -> str:
    name = html.escape(f"{group.title}: {training.label}")
    contents = base64.b64encode(training.film or b"").decode()
    return f'<figure><img alt="an episode" data-film="{contents}"><figcaption>{name}</figcaption></figure>'
