"""Tianshou's compiled functions, kept on disk: otherwise each process compiles them anew, for five seconds."""

from functools import cache

from tianshou.algorithm.algorithm_base import _gae, _nstep_return
from tianshou.data.buffer.manager import _next_index, _prev_index


@cache
def cache_compiled() -> None:
    """Have numba keep what it compiles of Tianshou."""
    for function in (_gae, _nstep_return, _next_index, _prev_index):
        function.enable_caching()
