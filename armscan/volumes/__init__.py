"""What the agent moves through: labelmap volumes, their files, phantom wrists, and the slicing plane."""

from armscan.volumes.dataset import MANIFEST_NAME, read_dataset
from armscan.volumes.phantom import load_phantom, load_phantoms, make_phantom
from armscan.volumes.plane import ManipulatorAction, RigidTransform, plane_distance, slid_into
from armscan.volumes.reading import read_volume
from armscan.volumes.volume import LABEL_NAMES, LANDMARK_LABELS, LabelVolume

__all__ = [
    "LABEL_NAMES",
    "LANDMARK_LABELS",
    "MANIFEST_NAME",
    "LabelVolume",
    "ManipulatorAction",
    "RigidTransform",
    "load_phantom",
    "load_phantoms",
    "make_phantom",
    "plane_distance",
    "read_dataset",
    "read_volume",
    "slid_into",
]
