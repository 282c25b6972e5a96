"""Labelmap volumes, their files and manifests, phantom wrists, and the slicing plane."""

from armscan.volumes.dataset import Dataset, open_dataset, read_dataset
from armscan.volumes.deformation import DeformingTransform
from armscan.volumes.labelmap import LABEL_NAMES, LANDMARK_LABELS, LabelMap
from armscan.volumes.manifest import MANIFEST_NAMES, record_planes
from armscan.volumes.markups import read_markup, write_markup
from armscan.volumes.phantom import load_phantom, load_phantoms, make_phantom
from armscan.volumes.plane import ManipulatorAction, plane_distance, shift_into
from armscan.volumes.reading import read_volume
from armscan.volumes.rigid_transform import RigidTransform
from armscan.volumes.volume import LabelVolume
from armscan.volumes.volume_report import VolumeReport

__all__ = [
    "LABEL_NAMES",
    "LANDMARK_LABELS",
    "MANIFEST_NAMES",
    "Dataset",
    "DeformingTransform",
    "LabelMap",
    "LabelVolume",
    "ManipulatorAction",
    "RigidTransform",
    "VolumeReport",
    "load_phantom",
    "load_phantoms",
    "make_phantom",
    "open_dataset",
    "plane_distance",
    "read_dataset",
    "read_markup",
    "read_volume",
    "record_planes",
    "shift_into",
    "write_markup",
]
