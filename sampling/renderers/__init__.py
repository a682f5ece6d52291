"""The renderers that the sampler draws from."""

from sampling.renderers.protocol import Renderer, Samples

__all__ = ["Renderer", "Samples"]
