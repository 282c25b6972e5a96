"""Export of a policy to files that do not require armscan: a torch program, and ONNX."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from armscan.agents.policy import ObservationTensors, Policy
from armscan.errors import ExportError, is_interruption, reason_of

if TYPE_CHECKING:
    from torch.export import ExportedProgram

# Names of the input, if the observation is one vector, and of the output; an input may already be called `action`.
OBSERVATION, NEXT_ACTION = "observation", "next_action"


def export_program(policy: Policy, batch: ObservationTensors) -> ExportedProgram:
    """Return a policy as a torch program, for batches of every size.

    Args:
        policy: Policy of a learner.
        batch: Batch of two observations or more; from one, the program would accept only one.

    Raises:
        ExportError: If torch.export cannot take the policy.
    """
    size = torch.export.Dim("n")
    shapes = {name: {0: size} for name in batch} if isinstance(batch, dict) else {0: size}
    with _quietly("torch.export"):
        return torch.export.export(policy, (batch,), dynamic_shapes=(shapes,))


def save_program(program: ExportedProgram, file: Path) -> None:
    """Write a program, as `torch.export.load` reads it."""
    with _quietly("torch.export"):
        torch.export.save(program, file)


def save_onnx(program: ExportedProgram, batch: ObservationTensors, file: Path) -> None:
    """Write a program as ONNX, with the parts of an observation as its inputs, for batches of every size.

    Args:
        program: Program that `export_program` returned.
        batch: Batch of observations, whose parts name the inputs.
        file: File to write, weights included.

    Raises:
        ExportError: If ONNX cannot take the program.
    """
    with _quietly("ONNX"):
        onnx = torch.onnx.export(
            program,
            dynamo=True,
            verbose=False,
            external_data=False,
            input_names=list(batch) if isinstance(batch, dict) else [OBSERVATION],
            output_names=[NEXT_ACTION],
        )
        assert onnx is not None
        onnx.save(file)


@contextmanager
def _quietly(what: str) -> Iterator[None]:
    """Silence the libraries of an export, and turn its errors into one line."""
    # torch.onnx reports that torchvision is missing.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    # Any exception: a user's network may contain operations that cannot be exported.
    except Exception as error:
        if is_interruption(error):
            raise
        raise ExportError(f"{what} cannot take the agent's network: {reason_of(error)}") from error
