"""A policy as an MLflow model folder, which requires torch, NumPy and MLflow, but not armscan."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import mlflow.pyfunc
import torch
import yaml
from mlflow.models import infer_signature
from numpy.typing import NDArray

from armscan.agents.policy import ObservationTensors, Policy
from armscan.agents.torch_export import export_program, save_onnx, save_program
from armscan.tracking.run import MODEL_FILE
from armscan.utils.files import sha256

PROGRAM_FILE, ONNX_FILE = "policy.pt2", "policy.onnx"
CODE = Path(__file__).with_name("pyfunc.py")
# All files of a model, relative to its folder.
FILES = (
    MODEL_FILE,
    f"artifacts/{PROGRAM_FILE}",
    "conda.yaml",
    "input_example.json",
    ONNX_FILE,
    "python_env.yaml",
    "requirements.txt",
    CODE.name,
    "serving_input_example.json",
)
# Folder of the bytecode that Python writes beside code.
BYTECODE = "__pycache__"
# Packages that the code requires, besides their own dependencies.
REQUIREMENTS = ("mlflow", "numpy", "torch")
# Observations as the model takes them: one array of shape (n, k), or the parts by name, each of shape (n, ...).
Arrays = NDArray[Any] | dict[str, NDArray[Any]]


def write_model(folder: Path, policy: Policy, batch: ObservationTensors, facts: Mapping[str, Any]) -> None:
    """Write a policy as a model, with an ONNX file beside it.

    Args:
        folder: Folder of the model, which must not exist yet.
        policy: Policy of a learner.
        batch: Batch of two or more observations, which gives their shapes; two of them become the model's input
            example.
        facts: Facts about the policy, as plain values; the model's metadata.

    Raises:
        ExportError: If torch.export or ONNX cannot take the policy.
    """
    program = export_program(policy, batch)
    example = {name: part[:2] for name, part in batch.items()} if isinstance(batch, dict) else batch[:2]
    with tempfile.TemporaryDirectory() as beside:
        file = Path(beside, PROGRAM_FILE)
        save_program(program, file)
        mlflow.pyfunc.save_model(
            folder,
            python_model=str(CODE),
            artifacts={"program": str(file)},
            signature=infer_signature(arrays_of(batch), arrays_of(policy(batch))),
            input_example=arrays_of(example),
            # Without a local version label, such as `+cpu`.
            pip_requirements=[f"{name}=={metadata.version(name).partition('+')[0]}" for name in REQUIREMENTS],
            metadata=dict(facts),
        )
    save_onnx(program, batch, folder / ONNX_FILE)


def is_model(folder: Path) -> bool:
    """Return whether a folder is a model that `write_model` wrote."""
    try:
        said = yaml.safe_load((folder / MODEL_FILE).read_bytes())
        return "armscan" in said["metadata"]
    except (OSError, yaml.YAMLError, TypeError, KeyError):
        return False


def others_in(folder: Path) -> list[str]:
    """Return the files in a model's folder that are neither part of a model nor bytecode, which loading it writes."""
    paths = (path.relative_to(folder) for path in folder.rglob("*"))
    found = {path.as_posix() for path in paths if BYTECODE not in path.parts}
    return sorted(found - {*FILES, *(str(Path(file).parent) for file in FILES)})


def model_sha256(folder: Path) -> str:
    """Return the SHA-256 of a model: of the lines that `sha256sum` prints for its files."""
    files = [name for name in FILES if (folder / name).is_file()]
    return sha256("".join(f"{sha256((folder / name).read_bytes())}  {name}\n" for name in files).encode())


def arrays_of(batch: ObservationTensors) -> Arrays:
    """Return a batch of tensors as the model takes it."""
    if isinstance(batch, torch.Tensor):
        return batch.numpy()
    return {name: part.numpy() for name, part in batch.items()}
