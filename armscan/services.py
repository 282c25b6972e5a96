"""Services that many machines share: where they are, by the environment or by a file that is in no repository.

A configuration names one by `${armscan.service:NAME}`, which is its address without a password, whoever resolves it and
wherever it is written then.
"""

from __future__ import annotations

import os
from pathlib import Path

import yaml
from omegaconf import OmegaConf

from armscan.errors import InvalidValueError, listed
from armscan.passwords import (
    STORAGE_PASSWORD,
    TRACKING_PASSWORD,
    hand_over_storage,
    hand_over_tracking,
)

# Beside where commands are typed.
LOCAL_FILE = Path("conf/local/services.yaml")
STORAGE, TRACKING = "storage", "tracking_uri"
VARIABLES = {STORAGE: "ARMSCAN_STORAGE", TRACKING: "MLFLOW_TRACKING_URI"}
HAND_OVER = {STORAGE: hand_over_storage, TRACKING: hand_over_tracking}
RESOLVER = "armscan.service"


def address_of(name: str, usual: str | None = None) -> str:
    """Returns the address of a service without its password, which is kept for this process and those that it starts.

    Args:
        name: `storage`, where studies are kept, or `tracking_uri`, where runs are tracked.
        usual: what it is where nothing is said; None where it must be said, here or in the local file.

    Raises:
        InvalidValueError: if it is said nowhere, or the local file is damaged.
    """
    variable = VARIABLES[name]
    address = os.environ.get(variable) or (usual if usual is not None else local_addresses().get(name))
    if not address:
        raise InvalidValueError(
            f"cluster needs the address of {name}, but neither {variable} is set nor is there a {name} in {LOCAL_FILE}"
        )
    return HAND_OVER[name](address)


def local_addresses() -> dict[str, str]:
    """Returns what the local file says, with passwords; nothing where there is none.

    Raises:
        InvalidValueError: if it says anything else than addresses of services.
    """
    try:
        said = yaml.safe_load(LOCAL_FILE.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        # What a parser shows of the line may be the password.
        raise InvalidValueError(f"{LOCAL_FILE} cannot be read: {type(error).__name__}") from None
    if said is None:
        return {}
    if not isinstance(said, dict) or not all(isinstance(address, str) for address in said.values()):
        raise InvalidValueError(f"{LOCAL_FILE} must hold nothing but {listed(VARIABLES)}, each with an address")
    if unknown := [name for name in said if name not in VARIABLES]:
        raise InvalidValueError(f"{LOCAL_FILE} has {unknown[0]!r}, but it must hold nothing but {listed(VARIABLES)}")
    return said


def hand_over_local() -> None:
    """Keeps the passwords of the local file for this process and those that it starts, where none are set."""
    for name, variable in ((STORAGE, STORAGE_PASSWORD), (TRACKING, TRACKING_PASSWORD)):
        if (address := local_addresses().get(name)) and variable not in os.environ:
            HAND_OVER[name](address)


# Whoever resolves a configuration, in whichever process, has imported this.
OmegaConf.register_new_resolver(RESOLVER, address_of, replace=True)
