"""Addresses of services that many machines share, from the environment or the user's file.

A configuration refers to one as `${armscan.service:NAME}`, which resolves to its address.
"""

from __future__ import annotations

import os
from pathlib import Path

import yaml
from omegaconf import OmegaConf
from platformdirs import user_config_path

from armscan.config.credentials import check_address
from armscan.errors import InvalidValueError, listed

STORAGE, TRACKING = "storage", "tracking_uri"
VARIABLES = {STORAGE: "ARMSCAN_STORAGE", TRACKING: "MLFLOW_TRACKING_URI"}
RESOLVER = "armscan.service"
# Ports of `armscan ui` on 127.0.0.1. The notes of studies and trials link to the first.
MLFLOW_PORT, DASHBOARD_PORT = 5000, 8080


def services_file() -> Path:
    """Return the path of the file with the addresses of services."""
    return user_config_path("armscan") / "services.yaml"


def address_of(name: str, default: str | None = None) -> str:
    """Return the address of a service. Environment variables take precedence.

    Args:
        name: Name of the service: `storage`, where studies are kept, or `tracking_uri`, where runs are tracked.
        default: Address to use if the variable is not set. Default: None, the one in `services_file`.

    Raises:
        InvalidValueError: If there is no address, it has a password, or the file is damaged.
    """
    variable = VARIABLES[name]
    if address := os.environ.get(variable):
        check_address(variable, address)
        return address
    if default is not None:
        return default
    if address := local_addresses().get(name):
        return address
    raise InvalidValueError(
        f"cluster needs the address of {name}, but neither {variable} is set nor is there a {name} in {services_file()}"
    )


def local_addresses() -> dict[str, str]:
    """Return the addresses in `services_file` by service; empty if there is no such file.

    Raises:
        InvalidValueError: If the file cannot be read, or has other keys or values.
    """
    file = services_file()
    try:
        addresses = yaml.safe_load(file.read_bytes()) or {}
    except FileNotFoundError:
        return {}
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        # The parser's message quotes the line, which may contain a password.
        raise InvalidValueError(f"{file} cannot be read: {type(error).__name__}") from None
    if not isinstance(addresses, dict) or not all(isinstance(address, str) for address in addresses.values()):
        raise InvalidValueError(f"{file} must contain only {listed(VARIABLES)}, each with an address")
    for name, address in addresses.items():
        if name not in VARIABLES:
            raise InvalidValueError(f"{file} has {name!r}, but it must contain only {listed(VARIABLES)}")
        check_address(f"{name} in {file}", address)
    return addresses


# Registered on import, in every process that resolves a configuration.
OmegaConf.register_new_resolver(RESOLVER, address_of, replace=True)
