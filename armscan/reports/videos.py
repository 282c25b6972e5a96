"""Videos of episodes side by side, started together."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

from armscan.reports.groups import Group
from armscan.reports.load import TrackedTraining

# A GIF starts when it is first shown, and all images with its address share it: each start needs new addresses.
PROGRAM = """
<script>
(() => {
  const videos = [...document.querySelectorAll(".videos img")];
  const contents = videos.map((video) => Uint8Array.from(atob(video.dataset.video), (letter) => letter.charCodeAt(0)));
  const start = () => videos.forEach((video, number) => {
    URL.revokeObjectURL(video.src);
    video.src = URL.createObjectURL(new Blob([contents[number]], {type: "image/gif"}));
  });
  document.querySelector("#start").addEventListener("click", start);
  // A page that is printed has them, too.
  start();
  new IntersectionObserver((seen, observer) => {
    if (seen.some((each) => each.isIntersecting)) { observer.disconnect(); start(); }
  }).observe(document.querySelector(".videos"));
})();
</script>
"""


def videos(groups: Sequence[Group]) -> str:
    """Return the section with a video of each group's median training, for groups that have videos."""
    chosen = [(group, training) for group in groups if (training := _median(group)) is not None]
    if not chosen:
        return "<h2>Episodes</h2><p>None of these runs has kept a video.</p>"
    return (
        "<h2>Episodes</h2><p>On the first test volume, of the training in the middle of its group by mean steps on the "
        "test volumes (of an even number, the better of two). The same seed and volume is the same episode. "
        '<button id="start">start together</button></p>'
        f'<div class="videos">{"".join(_figure(*each) for each in chosen)}</div>{PROGRAM}'
    )


def _median(group: Group) -> TrackedTraining | None:
    """Return the median training, by mean steps, of those with a video; an unevaluated one only if all are."""
    recorded = [training for training in group.trainings if training.video is not None]
    ranked = sorted((each for each in recorded if each.evaluation), key=_mean_steps) or recorded
    return ranked[(len(ranked) - 1) // 2] if ranked else None


def _mean_steps(training: TrackedTraining) -> float:
    return training.evaluation.mean_steps if training.evaluation else 0.0


def _figure(group: Group, training: TrackedTraining) -> str:
    name = html.escape(f"{group.title}: {training.label}")
    assert training.video is not None, "only trainings with a video are chosen"
    contents = base64.b64encode(training.video).decode()
    return f'<figure><img alt="an episode" data-video="{contents}"><figcaption>{name}</figcaption></figure>'
