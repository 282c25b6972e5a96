"""Measure how long each kind of agent trains on each device: `device=cpu` and, where there is one, `device=cuda`.

    python -m benchmarks.speed.devices [--rounds N] [CASE ...]

Each training is a run in a fresh process on one thread, tracked in SQLite; devices take turns. Budgets are short, so
the figures to quote are the ratios: wall seconds of the training on the CPU over those on the GPU.
"""

from __future__ import annotations

import statistics

import torch

from benchmarks.arguments import count, parser_of
from benchmarks.repository import REPOSITORY
from benchmarks.speed.training import SHORT, run
from benchmarks.tables import print_head, print_row

IMAGES = ["obs=slice_channels", "training.env_steps=3000", "training.eval_every_env_steps=1000"]
CASES = {
    "sac, vectors": ["training.env_steps=10000"],
    "ppo, vectors": ["agent=ppo", "training.env_steps=24576", "training.eval_every_env_steps=8192"],
    "sac, images": IMAGES,
    "sac, images, bfloat16": [*IMAGES, "compute.precision=bfloat16"],
    "ppo, images": ["agent=ppo", *IMAGES, "training.env_steps=8192", "training.eval_every_env_steps=4096"],
    "plane_finder": [
        "experiment=plane_finder",
        "data.n_training=16",
        "training.env_steps=18000",
        "training.eval_every_env_steps=18000",
    ],
}
QUICK = ["training.solved=null", "training.validation_episodes=16", "evaluation.episodes=12"]


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=count, default=3, metavar="N", help="rounds of all cases (default: 3)")
    parser.add_argument("cases", nargs="*", metavar="CASE", help="beginning of a name (default: all)")
    given = parser.parse_args()
    cases = [case for case in CASES if not given.cases or case.startswith(tuple(given.cases))]
    if not cases:
        parser.error(f"{' '.join(given.cases)} begins no name: {', '.join(CASES)}")
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    for device in devices:
        run(REPOSITORY, *SHORT, f"device={device}")
    ratio = ["cpu / cuda: median, least, most"] if devices[1:] else []
    print_head("agent", *(f"{device}, s" for device in devices), *ratio)
    for case in cases:
        rounds = [
            [run(REPOSITORY, *CASES[case], *QUICK, f"device={device}").training_wall_s for device in devices]
            for _ in range(given.rounds)
        ]
        cells = [f"{statistics.median(each):.1f}" for each in zip(*rounds, strict=True)]
        if ratio:
            ratios = [cpu_s / cuda_s for cpu_s, cuda_s in rounds]
            cells.append(f"{statistics.median(ratios):.2f}, {min(ratios):.2f}, {max(ratios):.2f}")
        print_row(case, *cells)


if __name__ == "__main__":
    main()
