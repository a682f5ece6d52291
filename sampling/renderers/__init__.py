"""What the sampler renders with."""

from sampling.renderers.protocol import Renderer, Samples

__all__ = ["Renderer", "Samples"]
