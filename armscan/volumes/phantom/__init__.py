"""Phantom wrists: anatomically plausible labelmaps from a seed, each with its optimal plane known by construction."""

from armscan.volumes.phantom.cache import load_phantom, load_phantoms
from armscan.volumes.phantom.generate import VERSIONS, make_phantom

__all__ = ["VERSIONS", "load_phantom", "load_phantoms", "make_phantom"]
