"""Adaptive rendering: samples go where their error would be seen (Section 3 of the paper)."""

from sampling.plugin import register_integrator
from sampling.renderers import Renderer, Samples
from sampling.renderers.llvm import find_llvm
from sampling.rendering import Result, Watch, render
from sampling.sampler import Report, Request, Sampler, Settings, rounds

__all__ = [
    "Renderer",
    "Report",
    "Request",
    "Result",
    "Sampler",
    "Samples",
    "Settings",
    "Watch",
    "find_llvm",
    "register_integrator",
    "render",
    "rounds",
]
