"""Large images, the finest levels strip by strip.

A strip stays in the processor's cache, and its memory is reused for the next one, whereas whole
planes would be requested from the system anew in every call.
"""

import torch
from torch import Tensor

from torch_vdm.model.cortex import Cortex
from torch_vdm.model.cortex.haar import lowpass_of_light
from torch_vdm.model.cortex.transform import Base, mean_of
from torch_vdm.model.distance import Paths
from torch_vdm.model.model import Model
from torch_vdm.run import schedule as limits
from torch_vdm.run.schedule import Schedule
from torch_vdm.run.tiling import Tile, Tiling, cut
from torch_vdm.run.whole import descended, differences, level_difference


def can_be_cut(image: Tensor) -> bool:
    """Return whether an image (B, 3, H, W) has more levels than are computed in strips."""
    height, width = image.shape[-2:]
    return max(height, width) > 1 << (limits.STRIP_LEVELS + 1)


def accumulated(model: Model, schedule: Schedule, test: Tensor, reference: Tensor) -> Tensor:
    """Return `Model.difference` of two images, (B, 1, h, w)."""
    size, count = (test.shape[-2], test.shape[-1]), limits.STRIP_LEVELS + 1
    transform, shifts = model.transform, model.transform.shifts
    options = schedule, model.observer.true_means
    # One level more than is computed, for the parents of the last.
    levels = model.levels(0, count)
    pooled = 2 * shifts - 1
    grid = model.grid(size)
    tiling = Tiling.strips(
        size, limits.STRIP, limits.STRIP_LEVELS, shifts, transform.reach + pooled, grid
    )
    octaves = count - shifts
    filtered = transform.csf == "filter"
    charging = model.observer.charging
    sources = [test, reference]
    if filtered:  # a filter needs the whole image
        sources = [model.cone_planes(image) for image in sources]
        sources += [model.filtered(planes) for planes in sources]

    def strip_of(strip: Tile, *images: Tensor) -> list[Tensor]:
        """Return the row means of two images, what `rest` needs, and what their levels add."""
        parts: list[Tensor] = []
        strips: list[Cortex] = []
        for image, contrast in zip(images[:2], images[2:] or (None, None), strict=True):
            light = image if filtered else model.cone_planes(image)
            rows = light.mean(-1, keepdim=True)
            planes = light if contrast is None else contrast
            part = tiling.grid_of(strip.around)
            cortex, reduced = transform.begin(planes, count, *options, grid=part)
            parts.append(cut(rows, (strip.within(1)[0], slice(None))))
            parts.append(cut(reduced, strip.within(2**octaves)))
            if filtered:
                base = Base(light, 0, (light.shape[-2], light.shape[-1]), rows)
                cortex = lowpass_of_light(cortex, base, model.observer.true_means)
                parts.append(cut(cortex.lowpass[shifts - 1], strip.within(2**octaves)))
            strips.append(cortex)
        for number in range(1, count):
            level, within = levels.only(number), strip.within(2 ** (count - number) // shifts)
            local = level_difference(model, schedule, strips[0], strips[1], number, level)
            parts.append(cut(local, within))
            if charging:
                parts.append(cut(model.change(strips[0], strips[1], number), within))
        return parts

    pieces = [
        strip_of(strip, *around)
        for strip, *around in zip(
            tiling, *(tiling.split_rows(source) for source in sources), strict=True
        )
    ]
    joined = [torch.cat(parts, -2) for parts in zip(*pieces, strict=True)]
    each = 3 if filtered else 2
    coarser: list[Cortex] = []
    for rows, *planes in (joined[:each], joined[each : 2 * each]):
        mean = mean_of(rows)
        bases = [Base(plane, octaves, size, mean) for plane in planes]
        cortex = transform.rest(bases[0], *options)
        if filtered:
            cortex = lowpass_of_light(cortex, bases[1], model.observer.true_means)
        coarser.append(cortex)
    paths = differences(model, schedule, *coarser)
    fine = joined[2 * each :]
    kinds = 2 if charging else 1
    paths = Paths(
        (*paths.local, *fine[::kinds]),
        (*paths.changes, *fine[1::kinds]) if charging else (),
        paths.root,
    )
    return descended(model, schedule, paths, grid.down(len(paths.local)))
