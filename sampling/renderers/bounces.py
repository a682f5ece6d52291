"""Mitsuba's path tracer in Python, which also returns what its paths would be in other ways.

It is the same estimator as ``path``, with the same random numbers in the same order, so that every
sample is that of ``path``, bit for bit; and its light up to a given depth is that of ``path`` with
this ``max_depth``. So one pass measures what further bounces add.

``path`` looks for light in two ways at once and weighs both (multiple importance sampling): from
each surface it aims one ray at a light, and the ray that the material scatters may meet one by
chance. From the same walk follow the estimators that do only one of the two, what they would cost,
and how noisy they would be.

Mitsuba's module is passed in: `sampling.renderers.mitsuba` alone imports it.
"""

from typing import Any

# Largest survival probability in Russian roulette. Status: source, Mitsuba's `path`.
LIKELIEST = 0.95

# Mitsuba's `max_depth` where there is no limit.
NO_LIMIT = 2**32 - 1

# What finds light: both, as in `path`; rays aimed at lights, and chance only where no such ray
# could have found it; rays that materials scatter, which never meet a light without an area.
BOTH, LIGHTS, MATERIALS = "both", "lights", "materials"

# The AOVs of `make`, by what they are.
LIGHT_AOVS = tuple(f"{what}.{colour}" for what in ("short", "alone") for colour in "RGB")
MOMENT_AOVS = ("excess.lights", "excess.materials")
COUNT_AOVS = ("rays", "rays.both", "rays.lights", "rays.materials")


def make(
    mi: Any, dr: Any, max_depth: int | None, rr_depth: int, cut: int | None, found_by: str = BOTH
) -> Any:
    """Return the integrator for the active variant of Mitsuba.

    Its AOVs:

    - ``short``: the light of paths of at most ``cut`` segments. ``alone``: by ``found_by``.
    - ``excess``: how much larger the second moment of the latter would be by lights or materials
      alone than by both, summed over R, G, B, an estimate for each sample. It is not taken
      from the samples of the former: a pilot by materials alone may never meet the light that makes
      them noisy. It is measured at each surface by both kinds of rays, with the weights of both;
      products of light from two surfaces of a path are left out.
    - ``rays``: how many are traced, those aimed at lights included; ``rays.both``, ``rays.lights``
      and ``rays.materials`` for the short paths.

    Emitters are visible, and there are no media.

    Parameters
    ----------
    mi, dr
        Mitsuba and Dr.Jit.
    max_depth, rr_depth
        As in ``path``; None: no limit.
    cut
        Path segments, at least 1; None: ``max_depth``.
    found_by
        `BOTH`, `LIGHTS` or `MATERIALS`. Another one, or another cut, needs no recompilation.
    """
    base: Any = mi.SamplingIntegrator
    most = NO_LIMIT if max_depth is None else max_depth
    longest = dr.opaque(mi.UInt32, most if cut is None else min(cut, most))
    by_lights = dr.opaque(mi.Bool, found_by == LIGHTS)
    by_materials = dr.opaque(mi.Bool, found_by == MATERIALS)
    context = mi.BSDFContext()

    class Bounces(base):  # type: ignore[misc]  # its base is known once Mitsuba is loaded
        """Traces paths, and returns what each would be in other ways."""

        def aov_names(self) -> list[str]:
            """Return the names of the AOVs."""
            return [*LIGHT_AOVS, *MOMENT_AOVS, *COUNT_AOVS]

        def sample(
            self,
            scene: Any,
            sampler: Any,
            ray: Any,
            medium: Any = None,  # noqa: ARG002  # Mitsuba's signature
            active: Any = True,
        ) -> tuple[Any, Any, list[Any]]:
            """Return the light along rays, whether they hit something, and the AOVs."""

            def follow(
                path: tuple[Any, ...],
                light: Any,
                sampler: Any,
                short: Any,
                alone: Any,
                aim: Any,
                excess: Any,
                count: Any,
            ) -> tuple[Any, ...]:
                """Extend paths by one segment; each operation as and where ``path`` has it."""
                active, depth, ray, throughput, _, before, density, sharp, _ = path
                within, soon = depth + 1 <= longest, depth + 2 <= longest
                surface = scene.ray_intersect(
                    ray, ray_flags=+mi.RayFlags.All, coherent=depth == 0, active=active
                )
                # Light that was hit by chance: a path of depth + 1 segments.
                met = mi.DirectionSample3f(scene, surface, before)
                other = scene.pdf_emitter_direction(before, met, ~sharp & active)
                emitted = met.emitter.eval(surface, active & (density > 0.0))
                part = _share(dr, density, other)
                light = dr.fma(throughput, emitted * part, light)
                short = dr.select(within, light, short)
                kept = dr.select(by_lights & (other > 0.0), 0.0, 1.0)
                kept = dr.select(by_lights | by_materials, kept, part)
                alone = dr.select(within, dr.fma(throughput, emitted * kept, alone), alone)
                # The moments of both kinds of rays, aimed before and scattered, from one surface.
                whole = throughput * emitted
                own = dr.squared_norm(whole * part) + 2.0 * dr.dot(whole * part, aim)
                moment = dr.squared_norm(whole) * part
                lit = within & (density > 0.0) & (dr.max(whole) > 0.0)
                excess = excess + mi.Vector2f(
                    dr.select(lit & (other > 0.0), moment * density / other - own, 0.0),
                    dr.select(lit, moment - own, 0.0),
                )
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
                part = dr.select(met.delta, 1.0, _share(dr, met.pdf, other))
                light = dr.select(aimed, dr.fma(throughput, value * weight * part, light), light)
                short = dr.select(soon, light, short)
                kept = dr.select(by_lights, 1.0, dr.select(by_materials, 0.0, part))
                alone = dr.select(
                    aimed & soon, dr.fma(throughput, value * weight * kept, alone), alone
                )
                whole = dr.select(aimed & soon, throughput * value * weight, 0.0)
                aim = whole * part
                own = dr.squared_norm(aim)
                moment = dr.squared_norm(whole) * part
                lit = ~met.delta & (dr.max(whole) > 0.0)
                excess = excess + mi.Vector2f(
                    dr.select(lit, moment - own, 0.0),
                    dr.select(lit, moment * met.pdf / other - own, 0.0),
                )
                ones = (mi.UInt32(dr.select(each, 1, 0)) for each in (aimed, aimed & soon))
                shot, shot_soon = ones
                count = count + mi.Vector4u(
                    1 + shot,
                    dr.select(within, 1, 0) + shot_soon,
                    dr.select(soon | (within & sharp), 1, 0) + shot_soon,
                    dr.select(within, 1, 0),
                )
                path = _onwards(
                    mi, dr, path, rr_depth, surface, bounce, reflected, onwards, sampler
                )
                return path, light, sampler, short, alone, aim, excess, count

            dark = mi.Color3f(0.0)
            state = (
                *(_begun(mi, dr, scene, ray, active), dark, sampler, dark, dark, dark),
                *(mi.Vector2f(0.0), mi.Vector4u(0)),
            )
            path, light, _, short, alone, _, excess, count = dr.while_loop(
                state, _active, follow, label="bounces"
            )
            valid = path[-1]
            short, alone = (dr.select(valid, each, 0.0) for each in (short, alone))
            return (
                dr.select(valid, light, 0.0),
                valid,
                [*short, *alone, *excess, *(mi.Float(each) for each in count)],
            )

        def to_string(self) -> str:
            """Return its name and depth."""
            return f"Bounces[max_depth = {most}, cut = {cut}, found_by = {found_by}]"

    return Bounces(mi.Properties("bounces"))


def alone(mi: Any, dr: Any, max_depth: int | None, rr_depth: int, found_by: str) -> Any:
    """Return the integrator that finds light by `LIGHTS` or `MATERIALS` alone.

    Its samples are ``alone`` of `make` with this ``max_depth`` as the cut, bit for bit.
    """
    base: Any = mi.SamplingIntegrator
    most = NO_LIMIT if max_depth is None else max_depth
    context = mi.BSDFContext()

    class Alone(base):  # type: ignore[misc]  # its base is known once Mitsuba is loaded
        """A path tracer without multiple importance sampling."""

        def sample(
            self,
            scene: Any,
            sampler: Any,
            ray: Any,
            medium: Any = None,  # noqa: ARG002  # Mitsuba's signature
            active: Any = True,
        ) -> tuple[Any, Any, list[Any]]:
            """Return the light along rays, whether they hit something, and no AOVs."""

            def follow(path: tuple[Any, ...], light: Any, sampler: Any) -> tuple[Any, ...]:
                """Extend paths by one segment."""
                active, depth, ray, throughput, _, before, density, sharp, _ = path
                surface = scene.ray_intersect(
                    ray, ray_flags=+mi.RayFlags.All, coherent=depth == 0, active=active
                )
                met = mi.DirectionSample3f(scene, surface, before)
                seen = active & (density > 0.0)
                if found_by == LIGHTS:
                    seen &= scene.pdf_emitter_direction(before, met, ~sharp & active) == 0.0
                light = dr.fma(throughput, met.emitter.eval(surface, seen), light)
                onwards = active & (depth + 1 < most) & surface.is_valid()
                bsdf, aim = surface.bsdf(ray), sampler.next_2d()
                which, where = sampler.next_1d(), sampler.next_2d()
                if found_by == LIGHTS:
                    aimed = onwards & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                    met, weight = scene.sample_emitter_direction(surface, aim, True, aimed)
                    aimed &= met.pdf != 0.0
                    value, _, bounce, reflected = bsdf.eval_pdf_sample(
                        context, surface, surface.to_local(met.d), which, where, onwards
                    )
                    light = dr.select(aimed, dr.fma(throughput, value * weight, light), light)
                    # A last segment could only meet light that an aimed ray has found.
                    sharp = mi.has_flag(bounce.sampled_type, mi.BSDFFlags.Delta)
                    going = onwards & ((depth + 2 < most) | sharp)
                else:
                    bounce, reflected = bsdf.sample(context, surface, which, where, onwards)
                    going = onwards
                path = _onwards(mi, dr, path, rr_depth, surface, bounce, reflected, going, sampler)
                return path, light, sampler

            state = _begun(mi, dr, scene, ray, active), mi.Color3f(0.0), sampler
            path, light, _ = dr.while_loop(state, _active, follow, label="alone")
            return dr.select(path[-1], light, 0.0), path[-1], []

        def to_string(self) -> str:
            """Return its name and depth."""
            return f"Alone[max_depth = {most}, found_by = {found_by}]"

    return Alone(mi.Properties("alone"))


def _begun(mi: Any, dr: Any, scene: Any, ray: Any, active: Any) -> tuple[Any, ...]:
    """Return paths without a segment.

    They are: which go on, their segments, the next ray, throughput, product of indices of
    refraction, the last surface, the density of the next ray, whether it is that of a mirror or
    clear, and whether anything was hit.
    """
    return (
        *(mi.Bool(active), mi.UInt32(0), mi.Ray3f(ray), mi.Color3f(1.0), mi.Float(1.0)),
        *(dr.zeros(mi.Interaction3f), mi.Float(1.0), mi.Bool(True)),
        mi.Bool(scene.environment() is not None),
    )


def _active(path: tuple[Any, ...], *_: Any) -> Any:
    return path[0]


def _onwards(
    mi: Any,
    dr: Any,
    path: tuple[Any, ...],
    rr_depth: int,
    surface: Any,
    bounce: Any,
    reflected: Any,
    onwards: Any,
    sampler: Any,
) -> tuple[Any, ...]:
    """Return paths with their next ray, after roulette."""
    active, depth, ray, throughput, eta, _, _, _, valid = path
    away = surface.spawn_ray(surface.to_world(bounce.wo))
    ray = dr.select(active, away, ray)
    throughput = throughput * reflected
    eta = eta * bounce.eta
    sampled = bounce.sampled_type
    valid |= active & surface.is_valid() & ~mi.has_flag(sampled, mi.BSDFFlags.Null)
    before = mi.Interaction3f(surface.t, surface.time, surface.wavelengths, surface.p, surface.n)
    depth = dr.select(surface.is_valid(), depth + 1, depth)
    largest = dr.max(throughput)
    likely = dr.minimum(largest * dr.square(eta), LIKELIEST)
    gambled = depth >= rr_depth
    lucky = sampler.next_1d() < likely
    throughput = dr.select(gambled, throughput * dr.rcp(likely), throughput)
    active = onwards & (~gambled | lucky) & (largest != 0.0)
    sharp = mi.has_flag(sampled, mi.BSDFFlags.Delta)
    return active, depth, ray, throughput, eta, before, bounce.pdf, sharp, valid


def _share(dr: Any, own: Any, other: Any) -> Any:
    """Return the power heuristic's weight of the first of two densities."""
    own, other = own * own, other * other
    weight = own / (own + other)
    return dr.select(dr.isfinite(weight), weight, 0.0)
