"""A Lambertian material for Mitsuba, sampled uniformly over the hemisphere.

Blind Monte Carlo as the paper describes it (Section 4.1) sends rays "at random directions". A ray
that hits the light returns 2 rho L cos(theta), any other 0; how many hit it depends on the light's
solid angle alone, so the relative noise is the same wherever the whole light is visible. Mitsuba's
own ``diffuse`` samples by the cosine, and its relative noise grows in the dark.

Mitsuba's module is passed in: `sampling.renderers.mitsuba` alone imports it.
"""

from typing import Any

# Its name in a scene: <bsdf type="hemisphere">, with a texture or a colour ``reflectance``.
NAME = "hemisphere"

# The reflectance where the scene gives none, as in Mitsuba's ``diffuse``. Status: choice.
REFLECTANCE = 0.5


def register(mi: Any, dr: Any) -> None:
    """Register the material with the active variant of Mitsuba."""
    base: Any = mi.BSDF
    warp: Any = mi.warp
    cosine: Any = mi.Frame3f.cos_theta

    class Hemisphere(base):  # type: ignore[misc]  # its base is known once Mitsuba is loaded
        """One-sided Lambertian reflection, sampled without its cosine."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.reflectance = properties.get_texture("reflectance", REFLECTANCE)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        # Unused arguments are in Mitsuba's signatures.
        def sample(
            self,
            context: Any,
            surface: Any,
            sample1: Any,  # noqa: ARG002  # Mitsuba's signature
            sample2: Any,
            active: Any = True,
        ) -> tuple[Any, Any]:
            """Return a direction, and the BSDF times its cosine over the density."""
            found = mi.BSDFSample3f()
            found.wo = warp.square_to_uniform_hemisphere(sample2)
            found.pdf = warp.square_to_uniform_hemisphere_pdf(found.wo)
            found.eta = 1.0
            found.sampled_type = +mi.BSDFFlags.DiffuseReflection
            found.sampled_component = 0
            value = self.eval(context, surface, found.wo, active) * dr.rcp(found.pdf)
            return found, value

        def eval(
            self,
            context: Any,  # noqa: ARG002  # Mitsuba's signature
            surface: Any,
            outwards: Any,
            active: Any = True,
        ) -> Any:
            """Return rho cos(theta) / pi, 0 below the surface."""
            above = self._above(surface, outwards, active)
            light = self.reflectance.eval(surface, above) * (dr.inv_pi * cosine(outwards))
            return light & above

        def pdf(
            self,
            context: Any,  # noqa: ARG002  # Mitsuba's signature
            surface: Any,
            outwards: Any,
            active: Any = True,
        ) -> Any:
            """Return the density of a direction, 1 / (2 pi)."""
            above = self._above(surface, outwards, active)
            return dr.select(above, warp.square_to_uniform_hemisphere_pdf(outwards), 0.0)

        def eval_pdf(
            self, context: Any, surface: Any, outwards: Any, active: Any = True
        ) -> tuple[Any, Any]:
            """Return `eval` and `pdf`."""
            return (
                self.eval(context, surface, outwards, active),
                self.pdf(context, surface, outwards, active),
            )

        def eval_diffuse_reflectance(self, surface: Any, active: Any = True) -> Any:
            """Return the albedo."""
            return self.reflectance.eval(surface, active)

        def traverse(self, callback: Any) -> None:
            """Expose the reflectance."""
            callback.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            """Return its name and its reflectance."""
            return f"Hemisphere[reflectance={self.reflectance}]"

        def _above(self, surface: Any, outwards: Any, active: Any) -> Any:
            return active & (cosine(surface.wi) > 0.0) & (cosine(outwards) > 0.0)

    mi.register_bsdf(NAME, Hemisphere)
