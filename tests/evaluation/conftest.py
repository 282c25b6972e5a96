"""Runs to evaluate, and volumes of other sizes to evaluate them on."""

import numpy as np
import pytest
import SimpleITK
import yaml

from armscan.volumes.resampling import resample


@pytest.fixture
def coarse_folder(tmp_path, phantom):
    """Phantoms of other sizes and spacing, with a manifest that splits them."""
    folder = tmp_path / "coarse"
    folder.mkdir()
    entries = {}
    for name, spacing in (("a.nii.gz", (0.4, 0.5, 0.5)), ("b.nii.gz", (0.45, 0.55, 0.5))):
        volume = resample(phantom, spacing)
        image = SimpleITK.GetImageFromArray(np.ascontiguousarray(np.transpose(volume.labels)), isVector=False)
        image.SetSpacing(volume.spacing)
        SimpleITK.WriteImage(image, str(folder / name))
        plane = volume.optimal_action
        entries[name] = {"rotation": list(plane.rotation), "translation": list(plane.translation)}
    splits = {"train": ["a.nii.gz"], "test": ["b.nii.gz"]}
    (folder / "manifest.yaml").write_text(yaml.safe_dump({"volumes": entries, "splits": splits}))
    return folder
