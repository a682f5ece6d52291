"""Mitsuba's path tracer in Python, which also returns the light of short paths by itself.

It is the same estimator as ``path``, with the same random numbers in the same order, so that every
sample is that of ``path``, bit for bit; and its light up to a given depth is that of ``path`` with
this ``max_depth``. So one pass measures what further bounces add.

Mitsuba's module is passed in: `sampling.renderers.mitsuba` alone imports it.
"""

from typing import Any

# Largest survival probability in Russian roulette. Status: source, Mitsuba's `path`.
LIKELIEST = 0.95

# Mitsuba's `max_depth` where there is no limit.
NO_LIMIT = 2**32 - 1


def make(mi: Any, dr: Any, max_depth: int | None, rr_depth: int, cut: int) -> Any:
    """Return the integrator for the active variant of Mitsuba.

    Its AOVs are the light of paths of at most ``cut`` segments, R, G, B, and how many segments were
    traced. Emitters are visible, and there are no media.

    Parameters
    ----------
    mi, dr
        Mitsuba and Dr.Jit.
    max_depth, rr_depth
        As in ``path``; None: no limit.
    cut
        Path segments, at least 1. Another number needs no recompilation.
    """
    base: Any = mi.SamplingIntegrator
    most = NO_LIMIT if max_depth is None else max_depth
    longest = dr.opaque(mi.UInt32, cut)
    context = mi.BSDFContext()

    def share(own: Any, other: Any) -> Any:
        """Return the power heuristic's weight of the first of two densities."""
        own, other = own * own, other * other
        weight = own / (own + other)
        return dr.select(dr.isfinite(weight), weight, 0.0)

    class Bounces(base):  # type: ignore[misc]  # its base is known once Mitsuba is loaded
        """Traces paths, and returns what each would be if it were shorter."""

        def aov_names(self) -> list[str]:
            """Return the names of the AOVs."""
            return ["short.R", "short.G", "short.B", "segments"]

        def sample(
            self,
            scene: Any,
            sampler: Any,
            ray: Any,
            medium: Any = None,  # noqa: ARG002  # Mitsuba's signature
            active: Any = True,
        ) -> tuple[Any, Any, list[Any]]:
            """Return the light along rays, whether they hit something, and the AOVs."""

            def goes_on(active: Any, *_: Any) -> Any:
                return active

            def follow(
                active: Any,
                depth: Any,
                ray: Any,
                throughput: Any,
                light: Any,
                eta: Any,
                before: Any,
                density: Any,
                sharp: Any,
                valid: Any,
                segments: Any,
                sampler: Any,
                short: Any,
            ) -> tuple[Any, ...]:
                """Extend paths by one segment; each operation as and where ``path`` has it."""
                segments += 1
                surface = scene.ray_intersect(
                    ray, ray_flags=+mi.RayFlags.All, coherent=depth == 0, active=active
                )
                # Light that was hit by chance: a path of depth + 1 segments.
                met = mi.DirectionSample3f(scene, surface, before)
                other = scene.pdf_emitter_direction(before, met, ~sharp & active)
                emitted = met.emitter.eval(surface, active & (density > 0.0))
                light = dr.fma(throughput, emitted * share(density, other), light)
                short = dr.select(depth + 1 <= longest, light, short)
                onwards = active & (depth + 1 < most) & surface.is_valid()
                # Emitter sampling: a path of depth + 2 segments.
                bsdf = surface.bsdf(ray)
                aimed = onwards & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                met, weight = scene.sample_emitter_direction(
                    surface, sampler.next_2d(), True, aimed
                )
                aimed &= met.pdf != 0.0
                outwards = surface.to_local(met.d)
                which, where = sampler.next_1d(), sampler.next_2d()
                value, other, bounce, reflected = bsdf.eval_pdf_sample(
                    context, surface, outwards, which, where, onwards
                )
                part = dr.select(met.delta, 1.0, share(met.pdf, other))
                light = dr.select(aimed, dr.fma(throughput, value * weight * part, light), light)
                short = dr.select(depth + 2 <= longest, light, short)
                # The next segment.
                away = surface.spawn_ray(surface.to_world(bounce.wo))
                ray = dr.select(active, away, ray)
                throughput = throughput * reflected
                eta = eta * bounce.eta
                sampled = bounce.sampled_type
                valid |= active & surface.is_valid() & ~mi.has_flag(sampled, mi.BSDFFlags.Null)
                before = mi.Interaction3f(
                    surface.t, surface.time, surface.wavelengths, surface.p, surface.n
                )
                depth = dr.select(surface.is_valid(), depth + 1, depth)
                largest = dr.max(throughput)
                likely = dr.minimum(largest * dr.square(eta), LIKELIEST)
                gambled = depth >= rr_depth
                lucky = sampler.next_1d() < likely
                throughput = dr.select(gambled, throughput * dr.rcp(likely), throughput)
                active = onwards & (~gambled | lucky) & (largest != 0.0)
                sharp = mi.has_flag(sampled, mi.BSDFFlags.Delta)
                return (
                    *(active, depth, ray, throughput, light, eta, before, bounce.pdf, sharp),
                    *(valid, segments, sampler, short),
                )

            state = (
                *(mi.Bool(active), mi.UInt32(0), mi.Ray3f(ray), mi.Color3f(1.0), mi.Color3f(0.0)),
                *(mi.Float(1.0), dr.zeros(mi.Interaction3f), mi.Float(1.0), mi.Bool(True)),
                *(mi.Bool(scene.environment() is not None), mi.UInt32(0), sampler),
                mi.Color3f(0.0),
            )
            ended = dr.while_loop(state, goes_on, follow, label="bounces")
            short = dr.select(ended[9], ended[12], 0.0)
            return (
                dr.select(ended[9], ended[4], 0.0),
                ended[9],
                [short.x, short.y, short.z, mi.Float(ended[10])],
            )

        def to_string(self) -> str:
            """Return its name and depth."""
            return f"Bounces[max_depth = {most}, cut = {cut}]"

    return Bounces(mi.Properties("bounces"))
