"""Adaptive rendering: samples go where their error would be seen (Section 3 of the paper)."""

from sampling.renderers import Renderer, Samples

__all__ = ["Renderer", "Samples"]
