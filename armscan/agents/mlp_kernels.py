"""Fully connected networks with ReLU and Adam, compiled: BLAS for products, loops for the rest.

Everything is float32 and updated in place. A network's weights are one vector: for each layer its weights, shape
(n_out, n_in), then its biases; one head or more follow the hidden layers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from llvmlite.binding import get_host_cpu_features
from numpy.typing import NDArray

from armscan.utils.compilation import cached_njit

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
F = np.float32
# Largest matrix product, in multiplications, for which OpenBLAS has faster kernels; only with AVX-512.
N_SMALL = 10**6 if get_host_cpu_features().get("avx512f") else 0
# Rows multiplied at once, if that makes the product small.
N_ROWS = 64
# Loops copy arrays: for a slice assignment, Numba would also compile its shape error's text, which takes two seconds.
# Sums may be reordered, so that their loops are vectorised. NaN stays NaN, so that divergence shows.
fast_njit = cached_njit(
    nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz", "arcp"}, boundscheck=False
)


class Weights(NamedTuple):
    """Weights of a network, their gradient, and Adam's state, shape (n,); `steps` has one number per tensor."""

    values: Floats
    gradient: Floats
    exp_avg: Floats
    exp_avg_sq: Floats
    steps: Floats


class Adam(NamedTuple):
    """Settings of an optimiser."""

    lr: float
    beta1: float
    beta2: float
    eps: float


class Layers(NamedTuple):
    """Values of a network's input and hidden layers for a batch, one layer after another, and their gradient."""

    sizes: Ints
    values: Floats
    gradient: Floats


@fast_njit
def layer_view(values: Floats, sizes: Ints, n_rows: int, which: int) -> Floats:
    """Return a view of one layer, shape (n_rows, sizes[which])."""
    start = n_rows * sizes[:which].sum()
    return values[start : start + n_rows * sizes[which]].reshape(n_rows, sizes[which])


@fast_njit
def is_small(b: Floats) -> bool:
    """Return whether the product of `N_ROWS` rows with a matrix is small."""
    small: bool = N_ROWS * b.size <= N_SMALL
    return small


@fast_njit
def product(a: Floats, b: Floats, out: Floats) -> None:
    """Fill `out`, shape (n, m), with `a @ b`, shapes (n, k) and (k, m), by blocks of rows if those are small."""
    n_rows = N_ROWS if is_small(b) else a.shape[0]
    for start in range(0, a.shape[0], n_rows):
        np.dot(a[start : start + n_rows], b, out[start : start + n_rows])


@fast_njit
def linear(x: Floats, weights: Floats, start: int, out: Floats, is_hidden: bool) -> int:
    """Compute a layer's values, with ReLU if it is hidden; return where the next layer's weights start."""
    n_out: int = out.shape[1]
    end: int = start + n_out * x.shape[1]
    columns = weights[start:end].reshape(n_out, x.shape[1]).T
    if is_small(columns):
        # Small kernels read transposed weights slowly.
        product(x, np.ascontiguousarray(columns), out)
    else:
        np.dot(x, columns, out)
    bias = weights[end : end + n_out]
    for i in range(out.shape[0]):
        for j in range(n_out):
            value = out[i, j] + bias[j]
            out[i, j] = F(0.0) if is_hidden and value < F(0.0) else value
    return end + n_out


@fast_njit
def linear_gradient(x: Floats, d_out: Floats, gradient: Floats, start: int) -> None:
    """Compute the gradient of a layer's weights and biases."""
    n_out, end = d_out.shape[1], start + d_out.shape[1] * x.shape[1]
    np.dot(d_out.T, x, gradient[start:end].reshape(n_out, x.shape[1]))
    d_bias = gradient[end : end + n_out]
    d_bias[:] = F(0.0)
    for i in range(d_out.shape[0]):
        for j in range(n_out):
            d_bias[j] += d_out[i, j]


@fast_njit
def input_gradient(d_out: Floats, weights: Floats, start: int, d_x: Floats) -> None:
    """Compute the gradient of a layer's input."""
    n_out, n_in = d_out.shape[1], d_x.shape[1]
    product(d_out, weights[start : start + n_out * n_in].reshape(n_out, n_in), d_x)


@fast_njit
def forward(weights: Floats, layers: Layers, n_rows: int) -> int:
    """Compute the hidden layers; return where the weights of the first head start."""
    start: int = 0
    for which in range(1, layers.sizes.size):
        out = layer_view(layers.values, layers.sizes, n_rows, which)
        start = linear(layer_view(layers.values, layers.sizes, n_rows, which - 1), weights, start, out, True)
    return start


@fast_njit
def backward(weights: Weights, layers: Layers, n_rows: int, start: int, of_input: bool) -> None:
    """Backpropagate the gradient of the last layer's values to the input, or else to all hidden layers' weights."""
    for which in range(layers.sizes.size - 1, 0, -1):
        x = layer_view(layers.values, layers.sizes, n_rows, which - 1)
        out = layer_view(layers.values, layers.sizes, n_rows, which)
        d_out = layer_view(layers.gradient, layers.sizes, n_rows, which)
        for i in range(n_rows):
            for j in range(out.shape[1]):
                d_out[i, j] = F(0.0) if out[i, j] <= F(0.0) else d_out[i, j]
        start -= out.shape[1] * (x.shape[1] + 1)
        if not of_input:
            linear_gradient(x, d_out, weights.gradient, start)
        if of_input or which > 1:
            d_x = layer_view(layers.gradient, layers.sizes, n_rows, which - 1)
            input_gradient(d_out, weights.values, start, d_x)


@fast_njit
def adam_step(weights: Weights, settings: Adam) -> None:
    """Take an Adam step, as torch does."""
    for i in range(weights.steps.size):
        weights.steps[i] += F(1.0)
    n_steps = weights.steps[0]
    step_size = F(settings.lr / (1.0 - settings.beta1**n_steps))
    root = F(math.sqrt(1.0 - settings.beta2**n_steps))
    share1, share2 = F(1.0 - settings.beta1), F(1.0 - settings.beta2)
    beta2, eps = F(settings.beta2), F(settings.eps)
    for i in range(weights.values.size):
        gradient = weights.gradient[i]
        exp_avg = weights.exp_avg[i] + share1 * (gradient - weights.exp_avg[i])
        exp_avg_sq = beta2 * weights.exp_avg_sq[i] + share2 * gradient * gradient
        weights.exp_avg[i], weights.exp_avg_sq[i] = exp_avg, exp_avg_sq
        weights.values[i] -= step_size * exp_avg / (np.sqrt(exp_avg_sq) / root + eps)
