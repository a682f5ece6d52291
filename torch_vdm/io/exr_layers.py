"""Which channels of an OpenEXR file are the image: layers, parts and views."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from torch_vdm.io.exr_header import Part, listed, short
from torch_vdm.io.refusal import ImageError

# Channels that make an image, in the order in which they are searched for.
MODELS = (("R", "G", "B"), ("Y", "RY", "BY"), ("X", "Y", "Z"), ("Y",))
RGB = MODELS[0]

# Renderers' names for red, green, blue and alpha, in either case.
_WORDS = {
    "R": ("r", "red"),
    "G": ("g", "green"),
    "B": ("b", "blue"),
    "A": ("a", "alpha"),
}

# Models that can only be a picture: X, Y, Z may be positions, and Y a depth.
_PICTURES = MODELS[:2]

# Names of the picture among layers that only contribute to it, in either case: Blender's and
# V-Ray's, Redshift's; and, as a whole name (albedo.color does not count), Arnold's and Nuke's.
# Status: choice.
_BEAUTY = ("combined", "beauty")
_BEAUTY_WHOLE = ("rgba", "rgb", "color", "colour")


class Layer(NamedTuple):
    """The channels of an image in a file."""

    part: int
    name: str
    """The layer's name, after the part's where there are several; without the view's."""
    prefix: str
    """The channels' names up to their last dot."""
    view: str
    """The eye; "" in a file that is not multi-view."""
    model: tuple[str, ...]
    """What the channels are: one of MODELS."""
    channels: tuple[str, ...]
    """Their names, in the model's order."""
    alpha: str | None


def choose(
    parts: list[Part],
    wanted: int | str | None,
    view: str | None,
    channels: Mapping[str, str] | None,
    notes: list[str],
) -> tuple[Layer, tuple[str, ...]]:
    """Return the layer to read, and the names of all views that it comes in."""
    if channels is not None:
        same = [_named_channels(parts, wanted, channels)]
    else:
        same = _best(parts, _candidates(parts, wanted))
    views = tuple(layer.view for layer in same if layer.view)
    chosen = same[0]
    if view is not None:
        if view not in views:
            raise ImageError(f"expected a view named {short(view)!r}, got {listed(list(views))}")
        chosen = same[views.index(view)]
    _tell(parts, chosen, views, notes)
    return chosen, views


def _best(parts: list[Part], candidates: list[Layer]) -> list[Layer]:
    """The candidates that look most like the picture: one, or its views."""

    def rank(layer: Layer) -> tuple[bool, int]:
        return parts[layer.part].deep, _likeness(layer)

    best = min(map(rank, candidates))
    same = [layer for layer in candidates if rank(layer) == best]
    _refuse_deep(parts[same[0].part])
    # Layers that differ only in the view are one picture.
    if len({layer.name for layer in same}) > 1 or len({layer.view for layer in same}) < len(same):
        raise ImageError(
            f"expected one image, got the layers {listed(_titles(parts, same))}; choose one with "
            "--part NAME"
        )
    order = _views(parts)
    return sorted(same, key=lambda layer: order.index(layer.view) if layer.view in order else -1)


def _likeness(layer: Layer) -> int:
    """How little a layer looks like the picture; layers of the same number are equally good."""
    own = layer.prefix in ("", layer.view)
    picture = layer.model in _PICTURES
    name = layer.name.lower()
    if not name and picture:
        return 0 if layer.model == RGB else 1
    if name in _BEAUTY_WHOLE or name.rpartition(".")[2] in _BEAUTY:
        return 2 if layer.model == RGB else 3
    if own and picture:  # the channels of a part
        return 4 if layer.model == RGB else 5
    return 6


def _candidates(parts: list[Part], wanted: int | str | None) -> list[Layer]:
    """The layers that `wanted` leaves to choose from."""
    found = list(_layers(parts))
    usual = [layer for layer in found if layer.prefix in ("", layer.view) or layer.model == RGB]
    indices: Sequence[int] = range(len(parts))
    if isinstance(wanted, int):
        if wanted not in indices:
            raise ImageError(f"expected a part from 0 to {len(parts) - 1}, got {wanted}")
        indices = [wanted]
    elif wanted is not None:
        indices = [i for i in indices if parts[i].name == wanted]
        if not indices:
            return _layers_called(parts, found, wanted)
    candidates = [layer for layer in usual if layer.part in indices]
    if wanted == "":  # the channels of no layer
        candidates = [layer for layer in candidates if layer.prefix in ("", layer.view)]
    if not candidates:
        part = parts[indices[0]]
        _refuse_deep(part)
        raise ImageError(
            f"expected channels R, G, B, or Y, RY, BY, or Y, got {listed(list(part.channels))}; "
            "export it with colour channels, or name them with --channels R=...,G=...,B=..."
        )
    return candidates


def _layers_called(parts: list[Part], found: list[Layer], wanted: str) -> list[Layer]:
    """The layers whose whole name is `wanted`, else the last word, else either ignoring case."""
    for fold in (str, str.lower):
        for names in (
            lambda layer: (layer.prefix, layer.name),
            lambda layer: (layer.prefix.rpartition(".")[2], layer.name.rpartition(".")[2]),
            lambda layer: (layer.view,),
        ):
            called = [x for x in found if fold(wanted) in [fold(name) for name in names(x)]]
            if called:
                return called
    named = [repr(part.name) for part in parts if part.name]
    layers = [repr(name) for name in dict.fromkeys(layer.prefix for layer in found) if name]
    raise ImageError(
        f"expected a part or a layer named {short(wanted)!r}, got "
        f"{'parts ' + listed(named) if named else 'no named parts'}"
        f"{' and layers ' + listed(layers) if layers else ''}"
    )


def _layers(parts: list[Part]) -> Iterator[Layer]:
    """Every group of channels that makes an image; for each prefix the first model that fits."""
    views = _views(parts)
    for index, part in enumerate(parts):
        for prefix, named in _groups(part).items():
            model = next((m for m in MODELS if all(name in named for name in m)), None)
            if model is None:
                continue
            layer, view = _split_view(prefix, views)
            view = _view_of(part) or view or (views[0] if views else "")
            owner = _part_title(part, view) if len(parts) > 1 else ""
            yield Layer(
                index,
                ".".join(filter(None, (owner, layer))),
                prefix,
                view,
                model,
                tuple(named[name] for name in model),
                named.get("A"),
            )


def _groups(part: Part) -> dict[str, dict[str, str]]:
    """By prefix: the channels' full names by "R", "G", "B", "A" or the channel's own name."""
    groups: dict[str, dict[str, str]] = {}
    # "R" comes before ".R", "r" and "red": where there are several, it is taken.
    for full in sorted(
        part.channels, key=lambda name: (len(name.rpartition(".")[2]), len(name), name)
    ):
        prefix, _, own = full.rpartition(".")
        letter = next((key for key, words in _WORDS.items() if own.lower() in words), own)
        # V-Ray's ".R" has an empty prefix, as "R" has.
        groups.setdefault(prefix, {}).setdefault(letter, full)
    return groups


def _views(parts: list[Part]) -> list[str]:
    """The names of the views, the default one first."""
    names: list[str] = []
    for part in parts:
        value = part.attributes.get("multiView", b"")
        at = 0
        while at + 4 <= len(value):  # a list of strings, each preceded by its length
            (length,) = struct.unpack_from("<i", value, at)
            if length < 0:
                break
            names.append(value[at + 4 : at + 4 + length].decode("utf-8", "backslashreplace"))
            at += 4 + length
        names.append(_view_of(part))
    return list(dict.fromkeys(filter(None, names)))


def _view_of(part: Part) -> str:
    return part.attributes.get("view", b"").decode("utf-8", "backslashreplace")


def _split_view(prefix: str, views: list[str]) -> tuple[str, str]:
    """The layer and the view of ``layer.view``, as channels of a multi-view part are named."""
    layer, _, last = prefix.rpartition(".")
    return (layer, last) if last in views else (prefix, "")


def _part_title(part: Part, view: str) -> str:
    """The part's name without the view's at its end."""
    return part.name.removesuffix(view).rstrip("._- ") if view else part.name


def _titles(parts: list[Part], layers: list[Layer]) -> list[str]:
    """Names by which layers can be asked for."""
    if len({layer.name for layer in layers}) == len(layers):
        return [repr(layer.name) if layer.name else "'' (no layer)" for layer in layers]
    return [f"part {layer.part} ({short(parts[layer.part].name)!r})" for layer in layers]


def _named_channels(
    parts: list[Part], wanted: int | str | None, channels: Mapping[str, str]
) -> Layer:
    """The layer that ``--channels`` describes, in the first part that has it."""
    if not set(RGB) <= set(channels) <= {*RGB, "A"}:
        raise ImageError(f"expected channels for R, G, B and perhaps A, got {listed([*channels])}")
    for index, part in enumerate(parts):
        if wanted in (None, index, part.name) and set(channels.values()) <= set(part.channels):
            names = tuple(channels[letter] for letter in RGB)
            return Layer(index, "", "", "", RGB, names, channels.get("A"))
    there = [name for part in parts for name in part.channels]
    raise ImageError(f"expected channels {listed([*channels.values()])}, got {listed(there)}")


def _refuse_deep(part: Part) -> None:
    if part.deep:
        raise ImageError(
            "expected one sample a pixel, got a deep image; flatten it where it is rendered"
        )


def _tell(parts: list[Part], chosen: Layer, views: tuple[str, ...], notes: list[str]) -> None:
    part = parts[chosen.part]
    _refuse_deep(part)
    if len(parts) > 1:
        notes.append(f"Of {len(parts)} parts, part {chosen.part} ({short(part.name)!r}) is read.")
    if len(views) > 1:
        notes.append(f"Of the views {listed(list(views))}, {short(chosen.view)} is read.")
    if chosen.channels != chosen.model:
        notes.append(f"The image is read from the channels {listed(list(chosen.channels))}.")
    if any(part.channels[name].kind == 0 for name in chosen.channels):
        notes.append("The channels hold whole numbers, which are taken as they are.")
    used = {*chosen.channels, chosen.alpha}
    others = [name for name in part.channels if name not in used]
    if others:
        notes.append(f"Channels that are not used: {listed(others)}.")
