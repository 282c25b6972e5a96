"""Measure how far from the labelled plane a slice can be at full reward, which limits the accuracy of agents.

    python -m benchmarks.learning.distance FOLDER

Draws 1,000 planes around the labelled plane of each of 12 phantoms that no reward was fitted to: the slice's centre is
moved by up to 10 mm along the labelled normal, both angles turned by up to 20 degrees, uniformly. Prints for each
reward the share of planes that it accepts, that is, that score above -success_threshold, and the median of their
distances. `its own plane` is fitted to the labelled plane of the phantom that is judged: a bound on what the features
can do, not possible for unseen wrists.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armscan.anatomy import AgreementReward, LandmarkReward, Reward, TissueClusters
from armscan.training.splits import mixed_data
from armscan.volumes import LabelVolume, ManipulatorAction
from armscan.volumes.plane import plane_distance
from benchmarks.arguments import parser_of, run_script
from benchmarks.tables import print_head, print_row

N_PLANES, OFFSET_MM, ANGLE_DEG = 1000, 10.0, 20.0


def near_planes(volume: LabelVolume, rng: np.random.Generator) -> list[ManipulatorAction]:
    """Draw planes around the labelled one, turned about the centre of its slice."""
    labelled = volume.optimal_action
    centre = np.array([volume.centre_mm[0], 0.0, volume.centre_mm[2]])
    centre_in_volume = labelled.matrix @ centre + labelled.offset_mm
    planes = []
    for offset_mm, *turn_deg in rng.uniform(-1.0, 1.0, (N_PLANES, 3)) * (OFFSET_MM, ANGLE_DEG, ANGLE_DEG):
        rotation = ManipulatorAction(tuple(np.add(labelled.rotation, turn_deg)), (0.0, 0.0))
        x_mm, y_mm, _ = centre_in_volume + offset_mm * labelled.normal - rotation.matrix @ centre
        planes.append(ManipulatorAction(rotation.rotation, (x_mm, y_mm)))
    return planes


def distances_of_accepted(
    volumes: list[LabelVolume], rewards: dict[str, tuple[Callable[[LabelVolume], Reward], float]]
) -> dict[str, list[tuple[float, float] | None]]:
    """Return for each reward the distance (mm, degrees) of every plane that it accepts, None for the other planes."""
    distances = {name: [] for name in rewards}
    rng = np.random.default_rng(0)
    for volume in volumes:
        of_volume = {name: reward_for(volume) for name, (reward_for, _) in rewards.items()}
        for plane in near_planes(volume, rng):
            landmarks = TissueClusters.from_slice(volume.slice(plane), pixel_mm=volume.pixel_mm).landmarks
            distance = plane_distance(plane, volume.optimal_action, volume.slice_centre_mm)
            for name, (_, success_threshold) in rewards.items():
                is_accepted = of_volume[name].score(landmarks, volume.pixel_mm) > -success_threshold
                distances[name].append(distance if is_accepted else None)
    return distances


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", help="labelmaps to fit the rewards to, beside phantoms")
    folder = parser.parse_args().folder
    split = mixed_data(folder, n_training=64, n_validation=1, n_test=12)
    fitted = AgreementReward().fit(split.training.values())
    tight = AgreementReward(slack=0.0, slack_mm=0.0).fit(split.training.values())
    rewards = {
        "every plane drawn": (lambda _: LandmarkReward(), np.inf),
        "published, success threshold 0.05": (lambda _: LandmarkReward(), 0.05),
        "published, success threshold 0.01": (lambda _: LandmarkReward(), 0.01),
        "agreement, success threshold 0.01": (lambda _: fitted, 0.01),
        "agreement without slack, success threshold 1e-9": (lambda _: tight, 1e-9),
        "agreement, its own plane, success threshold 1e-9": (
            lambda volume: AgreementReward().fit([volume]),
            1e-9,
        ),
    }
    print_head("", "accepted, %", "median, mm", "median, degrees")
    for name, distances in distances_of_accepted(list(split.test.values()), rewards).items():
        accepted = [distance for distance in distances if distance is not None]
        median_mm, median_deg = np.median(accepted, axis=0)
        print_row(name, f"{100 * len(accepted) / len(distances):.0f}", f"{median_mm:.1f}", f"{median_deg:.1f}")


if __name__ == "__main__":
    run_script(main)
