"""Samplers that read only numbers from a storage that may be untrusted."""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from typing import Any

import optuna
from optuna.trial import FrozenTrial

from armscan.errors import StudyError

# Classes of the state of CMA-ES, and the other names pickled with it by module; none of them executes anything.
STATES = {"CMA": "cmaes._cma", "SepCMA": "cmaes._sepcma", "CMAwM": "cmaes._cmawm"}
PICKLED = {
    **{module: {name} for name, module in STATES.items()},
    "numpy": {"dtype", "ndarray"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy.core.multiarray": {"_reconstruct", "scalar"},
}


class CmaEsSampler(optuna.samplers.CmaEsSampler):
    """Optuna's CMA-ES sampler, which keeps its state in the storage.

    Optuna's own unpickles its state from the storage, which can execute any code. This one unpickles numbers only.
    """

    def _restore_optimizer(self, completed_trials: Sequence[FrozenTrial]) -> Any:
        for trial in reversed(completed_trials):
            parts = {key: each for key, each in trial.system_attrs.items() if key.startswith(self._attr_key_optimizer)}
            if not parts:
                continue
            where = f"trial {trial.number}: the state of CMA-ES in its system attributes"
            try:
                state = _Numbers(io.BytesIO(bytes.fromhex(self._concat_optimizer_attrs(parts)))).load()
            # A damaged pickle raises exceptions of many types.
            except Exception as error:
                raise StudyError(f"{where} cannot be read: {error}") from error
            if type(state).__name__ not in STATES:
                raise StudyError(f"{where} is of the type {type(state).__name__!r}")
            return state
        return None


class _Numbers(pickle.Unpickler):
    """Unpickler of numbers, which refuses any other object before it is built."""

    def find_class(self, module: str, name: str) -> Any:
        """See `pickle.Unpickler`."""
        if name not in PICKLED.get(module, ()):
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not of CMA-ES")
        return super().find_class(module, name)
