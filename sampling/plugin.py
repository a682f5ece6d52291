"""A Mitsuba integrator that nests another and stops when nobody can see what is missing.

``sampling.register_integrator()`` registers it; in a scene it is

    <integrator type="vdm">
        <float name="tolerance" value="1"/>
        <integrator type="path"/>
    </integrator>

and `mi.render` of that scene is `sampling.render` of it.
"""

import sys
from typing import Any

import numpy as np

from sampling.renderers.filter import SCENE
from sampling.renderers.mitsuba import ALPHA, OWN, SceneError
from sampling.rendering import Result, render

# Its name in a scene: <integrator type="vdm">.
NAME = "vdm"


def register_integrator() -> None:
    """Register the integrator ``vdm`` with the active variant of Mitsuba.

    Its parameters are those of `render` that a scene may state: ``tolerance`` (JND), ``ppd`` and
    ``white`` (cd/m2), floats; ``strategy``, ``filter`` and ``effects``, strings; ``unbiased``, a
    boolean; and Mitsuba's ``timeout`` in seconds. The nested integrator computes the light.

    In `mi.render`, ``seed`` and ``sensor`` have their usual meaning. ``spp`` is the most samples
    that a pixel may get; 0: as many as it takes, since the scene's sampler and its number of
    samples are not used. The picture has the film's channels, including alpha and the nested
    integrator's AOVs; with ``develop=False`` it stays in the film. There are no derivatives.
    The integrator's ``result``, a `Result`, holds the last picture and why it was enough.

    Raises
    ------
    SceneError
        If Mitsuba has not been imported, or has no variant.
    """
    mi: Any = sys.modules.get("mitsuba")
    if mi is None or mi.variant() is None:
        raise SceneError(
            "expected Mitsuba with a variant, got none; import mitsuba and call mi.set_variant "
            "before the integrator is registered"
        )
    base: Any = mi.SamplingIntegrator

    class VisibleDifferenceIntegrator(base):  # type: ignore[misc]  # known once Mitsuba is loaded
        """Renders with another integrator until nobody can see what is missing."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            nested = [
                thing for _, thing in properties.objects() if isinstance(thing, mi.Integrator)
            ]
            if len(nested) != 1:
                raise ValueError(
                    f"expected one integrator inside {NAME}, such as path, got {len(nested)}"
                )
            self.nested = nested[0]
            self.options: dict[str, Any] = {
                name: properties.get(name, default)
                for name, default in (
                    ("tolerance", 1.0),
                    ("ppd", 60.0),
                    ("white", 100.0),
                    ("strategy", "perceptual"),
                    ("filter", SCENE),
                    ("effects", "auto"),
                    ("unbiased", False),
                )
            }
            timeout = properties.get("timeout", -1.0)
            self.options["time_limit"] = timeout if timeout > 0.0 else None
            self.result: Result | None = None

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,  # noqa: ARG002  # Mitsuba's signature; always evaluated
        ) -> Any:
            """Render; return the developed film, or an empty tensor without ``develop``."""
            view = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            self.result = render(
                scene,
                sensor=view,
                seed=seed if isinstance(seed, int) else int(seed[0]),
                max_spp=spp or None,
                integrator=self.nested,
                aov=OWN,
                **self.options,
            )
            film = view.film()
            names = self.aov_names()
            film.prepare(names)
            planes = dict(self.result.aovs)
            # The film's channels: R, G, B, A if it has one, the weight, and the AOVs.
            alpha = [planes.pop(ALPHA)] if ALPHA in planes else []
            weight = np.ones(self.result.samples.shape)
            channels = [*np.moveaxis(self.result.image, -1, 0), *alpha, weight, *planes.values()]
            pixels = np.stack(channels, -1).astype(np.float32)
            film.put_block(mi.ImageBlock(mi.TensorXf(pixels), film.crop_offset()))
            return film.develop() if develop else mi.TensorXf()

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> Any:
            """Return the nested integrator's result, for callers that sample single rays."""
            return self.nested.sample(scene, sampler, ray, medium, active)

        def aov_names(self) -> list[str]:
            """Return the names of the nested integrator's AOVs."""
            names: list[str] = self.nested.aov_names()
            return names

        def traverse(self, callback: Any) -> None:
            """Expose the nested integrator."""
            callback.put("nested", self.nested, mi.ParamFlags.NonDifferentiable)

        def to_string(self) -> str:
            """Return its name and the nested integrator."""
            return f"VisibleDifferenceIntegrator[\n  nested = {self.nested}\n]"

    mi.register_integrator(NAME, VisibleDifferenceIntegrator)
