"""Tensors in the states of learners."""

from __future__ import annotations

import torch


def named_tensors(tree: object, name: str = "") -> dict[str, torch.Tensor]:
    """Return every tensor of nested dicts and lists, by the names that lead to it."""
    if isinstance(tree, torch.Tensor):
        return {name: tree}
    parts = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list | tuple) else []
    return {key: tensor for part, tree in parts for key, tensor in named_tensors(tree, f"{name}/{part}").items()}


def assert_same_tensors(tree: object, other: object, tolerance: float = 0.0) -> None:
    """Check that both have tensors, and the same ones: by default to the bit."""
    tensors = named_tensors(tree)
    assert tensors
    torch.testing.assert_close(tensors, named_tensors(other), rtol=tolerance, atol=tolerance)
