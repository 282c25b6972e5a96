"""MLflow model of a policy: a stand-alone file, stored in the model, that does not import armscan."""

import zipfile
from typing import Any

import mlflow
import numpy as np
import torch
from mlflow.pyfunc.model import PythonModel, PythonModelContext
from numpy.typing import NDArray


class PyfuncPolicy(PythonModel):
    """A batch of observations in, shape (n, k), or each part by its name, shape (n, ...); actions out."""

    def load_context(self, context: PythonModelContext) -> None:
        """Read the policy's program; raise `ValueError` if it is damaged, which torch does not notice."""
        path = context.artifacts["program"]
        with zipfile.ZipFile(path) as program:
            damaged = program.testzip()
        if damaged is not None:
            raise ValueError(f"{path}: the policy is damaged, in {damaged}")
        self._policy = torch.export.load(path).module()

    def predict(
        self,
        context: PythonModelContext,
        # Or a dict of arrays; MLflow warns of any other hint.
        model_input: np.ndarray,
        params: dict[str, Any] | None = None,
    ) -> NDArray[np.float32]:
        """Return the actions, shape (n, n_action), within [-1, 1].

        Raises:
            ValueError: If an action is not finite, because the observations are not, or too large for 32 bits.
        """
        with torch.no_grad():
            if isinstance(model_input, dict):
                actions = self._policy({name: _tensor(part) for name, part in model_input.items()})
            else:
                actions = self._policy(_tensor(model_input))
        answer: NDArray[np.float32] = actions.numpy()
        if not np.isfinite(answer).all():
            raise ValueError(
                "the policy gives actions that are not finite: the observations must be finite 32-bit numbers"
            )
        return answer


def _tensor(part: NDArray[Any]) -> torch.Tensor:
    # Torch warns of read-only arrays.
    return torch.from_numpy(np.require(part, requirements=["C", "W"]))


mlflow.models.set_model(PyfuncPolicy())
