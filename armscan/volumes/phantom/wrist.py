"""The anatomy of a phantom wrist: its bones, tendons, artery and nerve as tubes in the wrist's own frame.

The frame is a right hand's, in mm: X towards the ulna (thumb at negative x), Y along the arm (fingers at negative y), Z
from the back of the hand to the palm. The carpal tunnel's plane is y = 0: it cuts the four bones of the distal carpal
row with the hook of the hamate, the three tendon groups and the ulnar artery.

Positions and sizes follow the proportions of an adult hand (Netter, Atlas of Human Anatomy, plates of the wrist and
hand), simplified to what a labelmap at 0.3 mm shows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from armscan.volumes.phantom.tube import Tube

BONE, TENDON, ARTERY, NERVE = 1, 2, 3, 4
TUNNEL_HALF_LENGTH_MM = 7.5

# x and z of the fingers at the knuckles, and y of the knuckles and of the joint beyond, thumb to little finger.
FINGER_X = (-41.0, -18.5, -1.0, 13.5, 26.0)
FINGER_Z = (9.0, 1.0, 0.0, 0.5, 2.0)
KNUCKLE_Y = (-50.0, -74.0, -73.0, -68.0, -61.0)
JOINT_Y = (-78.0, -113.0, -117.0, -109.0, -93.0)


def draw_wrist(rng: np.random.Generator) -> list[Tube]:
    """Draw the anatomy of one right wrist of standard size; bones come first, so that nothing cuts into them."""
    return [tube for tubes in draw_parts(rng).values() for tube in tubes]


def draw_parts(rng: np.random.Generator) -> dict[str, list[Tube]]:
    """Draw the same anatomy by the name of each part, in the same order."""
    spread = rng.uniform(0.92, 1.08)
    return {
        "forearm": list(_forearm_bones(rng)),
        "proximal row": list(_proximal_row(rng)),
        "distal row": list(_distal_row(rng)),
        "fingers": list(_finger_bones(rng, spread)),
        "accessory": list(_accessory_bones(rng)),
        "tendons": list(_tendons(rng, spread)),
        "vessel and nerve": list(_vessel_and_nerve(rng)),
    }


def _ovoid(rng: np.random.Generator, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Tube:
    """Return a carpal bone, its position and radii varied a little."""
    x, y, z = np.array(centre) + rng.normal(0.0, (0.2, 0.5, 0.35))
    radius_x, radius_y, radius_z = np.array(radii) * rng.uniform(0.95, 1.04, 3)
    return Tube.ovoid(BONE, (x, y, z), (radius_x, radius_y, radius_z))


def _forearm_bones(rng: np.random.Generator) -> Iterator[Tube]:
    """Return radius and ulna, each a shaft that widens towards the wrist, with its styloid process."""
    wide = rng.uniform(0.93, 1.07)
    y_radius = 27.0 + rng.normal(0.0, 0.7)
    yield Tube.cord(
        BONE,
        [
            (y_radius, -10.0, -1.0, 9.0 * wide, 5.0 * wide),
            (y_radius + 4.0, -10.0, -1.0, 13.5 * wide, 7.5 * wide),
            (y_radius + 18.0, -10.0, -1.0, 11.5 * wide, 7.0 * wide),
            (y_radius + 45.0, -11.0, -1.0, 8.0 * wide, 6.5 * wide),
            (180.0, -13.0, -1.0, 7.5 * wide, 6.5 * wide),
        ],
    )
    yield _ovoid(rng, (-27.0, 23.5, 3.5), (2.8, 6.5, 3.4))
    y_ulna = 31.0 + rng.normal(0.0, 0.7)
    yield Tube.cord(
        BONE,
        [
            (y_ulna, 14.5, 0.0, 5.0 * wide, 4.5 * wide),
            (y_ulna + 3.0, 14.5, 0.0, 7.2 * wide, 6.0 * wide),
            (y_ulna + 20.0, 14.5, 0.0, 6.0 * wide, 5.5 * wide),
            (180.0, 13.0, 0.0, 6.0 * wide, 5.8 * wide),
        ],
    )
    yield _ovoid(rng, (22.5, 24.5, -2.5), (2.5, 6.5, 3.0))


def _proximal_row(rng: np.random.Generator) -> Iterator[Tube]:
    """Return scaphoid, lunate, triquetrum and, palmar to it, the pisiform."""
    yield _ovoid(rng, (-16.0, 18.0, 1.0), (6.6, 6.6, 6.2))
    yield _ovoid(rng, (-2.5, 19.3, -1.0), (5.6, 6.2, 6.6))
    yield _ovoid(rng, (9.3, 18.3, -1.5), (4.9, 5.8, 5.2))
    yield _ovoid(rng, (17.8, 17.2, 8.6), (3.8, 5.4, 4.2))


def _distal_row(rng: np.random.Generator) -> Iterator[Tube]:
    """Return trapezium, trapezoid, capitate, and the hamate with its hook."""
    yield _ovoid(rng, (-24.5, 0.0, 4.5), (7.2, 11.0, 6.6))
    yield _ovoid(rng, (-10.8, 0.0, -1.0), (4.8, 10.8, 6.2))
    yield _ovoid(rng, (0.6, 0.5, -1.0), (5.0, 11.2, 7.6))
    yield _ovoid(rng, (13.0, 0.0, 0.0), (6.0, 10.8, 6.2))
    yield _ovoid(rng, (16.6, 0.0, 6.0), (2.0, 7.5, 5.0))


def _finger_bones(rng: np.random.Generator, spread: float) -> Iterator[Tube]:
    """Return five metacarpals and the phalanges beyond them."""
    base_x = (-27.5, -12.5, -0.8, 9.6, 19.2)
    base_z = (6.5, 0.0, -0.5, -0.3, 0.5)
    base_radius = (5.2, 4.7, 4.7, 4.2, 4.2)
    for finger in range(5):
        length = rng.uniform(0.93, 1.07)
        thick = base_radius[finger] * rng.uniform(0.95, 1.05)
        y_base = -14.3 + rng.normal(0.0, 0.5)
        knuckle = (FINGER_X[finger] * spread, KNUCKLE_Y[finger] * length, FINGER_Z[finger])
        joint = (FINGER_X[finger] * spread * 1.22, JOINT_Y[finger] * length, FINGER_Z[finger])
        tip = (FINGER_X[finger] * spread * 1.35, JOINT_Y[finger] * length - 26.0, FINGER_Z[finger])
        yield Tube.shaft(BONE, ((base_x[finger], y_base, base_z[finger]), knuckle), (thick, 0.8 * thick))
        yield Tube.shaft(BONE, (_beyond(knuckle), joint), (0.9 * thick, 0.72 * thick))
        if finger > 0:
            yield Tube.shaft(BONE, (_beyond(joint), tip), (0.8 * thick, 0.65 * thick))


def _accessory_bones(rng: np.random.Generator) -> Iterator[Tube]:
    """Return small bones on both sides of the carpus, distal and proximal to the tunnel, which a tilted plane cuts."""
    for x, z in ((-35.5, 10.0), (-36.0, -1.0), (27.0, 8.0), (27.5, -3.0)):
        yield _ovoid(rng, (x, -16.5, z), (2.8, 7.2, 3.4))
    for x, z in ((-32.0, 8.5), (-32.0, -3.0), (27.0, 6.0), (26.0, -5.0)):
        yield _ovoid(rng, (x, 17.5, z), (2.8, 8.0, 3.4))


def _beyond(joint: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the start of the next bone after a joint."""
    x, y, z = joint
    return x, y - 2.0, z


def _tendons(rng: np.random.Generator, spread: float) -> Iterator[Tube]:
    """Return five flexor tendons: one to each finger, three groups in the tunnel, bundles in the forearm.

    Within the tunnel the thumb's runs with the index finger's and the ring finger's with the little finger's. Towards
    the forearm all merge into one bundle, which splits again, further up, into a deep and a superficial one.
    """
    tunnel_x = (-11.0, -8.8, 0.0, 8.4, 10.6)
    palm_x = (-17.0, -9.5, -1.0, 7.0, 14.0)
    forearm_x = (-6.5, -3.5, 0.0, 3.5, 6.5)
    forearm_z = (10.2, 13.8, 10.2, 13.8, 10.2)
    z = 12.2 + rng.normal(0.0, 0.3)
    y_split = -TUNNEL_HALF_LENGTH_MM + rng.normal(0.0, 0.8)
    y_join = TUNNEL_HALF_LENGTH_MM + rng.normal(0.0, 0.8)
    for finger in range(5):
        thick = rng.uniform(0.95, 1.08)
        finger_z = 0.5 * (z + FINGER_Z[finger] + 9.0)
        finger_x = FINGER_X[finger] * spread
        shared = finger != 2
        radius = (2.1 if shared else 2.9) * thick
        yield Tube.cord(
            TENDON,
            [
                (JOINT_Y[finger] - 12.0, finger_x * 1.27, finger_z, 1.9 * thick, 2.0 * thick),
                (KNUCKLE_Y[finger], finger_x, finger_z, 2.0 * thick, 2.0 * thick),
                (y_split - 5.0, palm_x[finger], z, 1.9 * thick, 2.2 * thick),
                (
                    y_split,
                    tunnel_x[finger] + 0.9 * np.sign(finger - 1.5 - (finger > 2)) * shared,
                    z,
                    radius,
                    2.6 * thick,
                ),
                (y_split + 2.5, tunnel_x[finger], z, radius, 2.7 * thick),
                (y_join - 2.0, tunnel_x[finger], z, radius, 2.7 * thick),
                (y_join + 2.5, 0.75 * tunnel_x[finger], z, (3.4 if shared else 4.6) * thick, 2.8 * thick),
                (34.0, forearm_x[finger], z, 3.8 * thick, 3.0 * thick),
                (62.0, forearm_x[finger], forearm_z[finger], 4.0 * thick, 2.4 * thick),
                (85.0, forearm_x[finger], z + 1.6 * (forearm_z[finger] - 12.0), 4.2 * thick, 2.2 * thick),
                (180.0, forearm_x[finger], z + 1.6 * (forearm_z[finger] - 12.0), 4.2 * thick, 2.2 * thick),
            ],
        )


def _vessel_and_nerve(rng: np.random.Generator) -> Iterator[Tube]:
    """Return the ulnar artery, palmar to hook and pisiform, and the median nerve, palmar to the tendons."""
    thick = rng.uniform(0.92, 1.12)
    x, z = rng.normal(0.0, 0.5), rng.normal(0.0, 0.3)
    yield Tube.cord(
        ARTERY,
        [
            (-30.0 + rng.normal(0.0, 1.5), 5.5 + x, 17.6 + z, 1.3 * thick, 1.4 * thick),
            (-14.0, 11.5 + x, 17.6 + z, 1.5 * thick, 1.5 * thick),
            (0.0, 16.5 + x, 17.2 + z, 1.6 * thick, 1.6 * thick),
            (18.0, 16.0 + x, 17.2 + z, 1.6 * thick, 1.6 * thick),
            (60.0, 16.5 + x, 14.5 + z, 1.7 * thick, 1.7 * thick),
            (180.0, 18.0 + x, 12.5 + z, 1.8 * thick, 1.8 * thick),
        ],
    )
    x, z = rng.normal(0.0, 0.8), rng.normal(0.0, 0.2)
    yield Tube.cord(
        NERVE,
        [
            (-18.0, -5.0 + x, 16.6 + z, 2.6, 1.0),
            (0.0, -4.0 + x, 16.8 + z, 2.6, 1.1),
            (40.0, -2.0 + x, 16.6 + z, 2.5, 1.2),
            (180.0, -2.0 + x, 17.8 + z, 2.4, 1.2),
        ],
    )
