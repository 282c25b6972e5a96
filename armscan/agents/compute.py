"""Device and precision of tensors, and compilation of networks."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from armscan.agents.convolutions import images_of
from armscan.errors import InvalidValueError
from armscan.utils.validation import check_bool, check_choice

if TYPE_CHECKING:
    from gymnasium import spaces
    from torch import nn

DEVICES = ("auto", "cpu", "cuda")
PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class Compute:
    """Device and precision of tensors, and compilation of networks.

    Args:
        device: Device of the tensors: `cpu`, `cuda`, or `auto`, which is `cuda` if torch finds a CUDA device, but `cpu`
            for agents without images (see `for_space`). Default: `auto`.
        precision: Precision of the products: `float32`, or `bfloat16` for mixed precision (products in 16 bits, sums
            and weights in 32). Default: `float32`.
        compile: Whether to compile networks with `torch.compile`, which takes a minute and requires a C++ compiler.
            Default: False.

    Raises:
        InvalidValueError: If a value is unknown, or torch finds no such device.
    """

    device: str = "auto"
    precision: str = "float32"
    compile: bool = False

    def __post_init__(self) -> None:
        check_choice("device", self.device, DEVICES)
        check_choice("compute.precision", self.precision, PRECISIONS)
        check_bool("compute.compile", self.compile)
        if self.device == "cuda" and not _has_cuda():
            raise InvalidValueError("device is 'cuda', but torch finds no CUDA device here; it must be 'cpu' or 'auto'")

    @property
    def torch_device(self) -> str:
        """The device that tensors are on: `cpu` or `cuda`."""
        return "cuda" if self.device == "cuda" or (self.device == "auto" and _has_cuda()) else "cpu"

    def for_space(self, space: spaces.Space[Any]) -> Compute:
        """Return the settings for an agent with these observations: `auto` is `cpu` without images.

        Args:
            space: Observation space of one environment.
        """
        return self if self.device != "auto" or images_of(space) else replace(self, device="cpu")

    @property
    def is_float32_on_cpu(self) -> bool:
        """Whether tensors are on the CPU in 32 bits, so that a plain copy of a network computes the same."""
        return self.torch_device == "cpu" and self.precision == "float32"

    def apply_to(self, network: nn.Module) -> None:
        """Make a network compute this way from now on; its inputs and outputs stay in 32 bits."""
        if self.precision == "bfloat16":
            import torch

            forward = network.forward
            device = self.torch_device

            def precise(*args: Any, **kwargs: Any) -> Any:
                with torch.autocast(device, dtype=torch.bfloat16):
                    return _in_32_bits(forward(*args, **kwargs))

            network.forward = precise
        if self.compile:
            network.compile()


def plain_copy(network: nn.Module) -> nn.Module:
    """Return a copy of a network that computes in 32 bits on the CPU, undoing `Compute.apply_to`."""
    import torch

    # The copy of a compiled network is not compiled.
    copied = deepcopy(network)
    # Parts that other networks share may compute in another precision too.
    for module in copied.modules():
        vars(module).pop("forward", None)
    return copied.to("cpu", torch.float32)


def _in_32_bits(output: Any) -> Any:
    import torch

    if isinstance(output, tuple):
        return tuple(map(_in_32_bits, output))
    return output.float() if isinstance(output, torch.Tensor) else output


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()
