"""Actions of many observations at once, each the same as alone."""

import numpy as np
import torch

from armscan.agents.inference import linear_rows


def test_linear_rows_are_torchs_to_rounding():
    rng = np.random.default_rng(0)
    rows, weights, bias = (rng.normal(size=shape).astype(np.float32) for shape in ((5, 19), (33, 19), (33,)))
    wanted = torch.nn.functional.linear(*map(torch.from_numpy, (rows, weights, bias))).numpy()
    np.testing.assert_allclose(linear_rows(rows, weights, bias), wanted, rtol=0, atol=1e-5)


def test_linear_rows_do_not_depend_on_one_another():
    rng = np.random.default_rng(1)
    rows, weights, bias = (rng.normal(size=shape).astype(np.float32) for shape in ((67, 130), (71, 130), (71,)))
    together = linear_rows(rows, weights, bias)
    for n in (1, 2, 3, 8, 33):
        np.testing.assert_array_equal(linear_rows(rows[:n].copy(), weights, bias), together[:n])
    for row in range(len(rows)):
        np.testing.assert_array_equal(linear_rows(rows[row : row + 1], weights, bias)[0], together[row])


def test_linear_rows_take_layers_of_a_single_unit():
    rows, weights, bias = np.ones((2, 1), np.float32), np.full((1, 1), 3.0, np.float32), np.ones(1, np.float32)
    assert linear_rows(rows, weights, bias).tolist() == [[4.0], [4.0]]
