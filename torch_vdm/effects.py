"""Which effects are simulated."""

from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Self

from torch_vdm.options import switch


@dataclass(frozen=True)
class Effects:
    """Switches of effects; an effect that is off is not computed.

    Attributes
    ----------
    aberration
        The eye's optics attenuate the S cones' details. Off: factor 1.
    chromatic
        The channels C1 and C2. Off: the achromatic channel A alone.
    masking
        The transducer. Off: the response is the weighted contrast, 1 at threshold.
    pooling
        The 3x3 pooling. Off: every node by itself.
    """

    aberration: bool = True
    chromatic: bool = True
    masking: bool = True
    pooling: bool = True

    def __post_init__(self) -> None:
        """Refuse anything but True or False."""
        for field in fields(self):
            switch(field.name, getattr(self, field.name))

    @classmethod
    def named(cls, names: Collection[str]) -> Self:
        """Return the switches of which those of these names are on."""
        return cls(**{field.name: field.name in names for field in fields(cls)})

    def names(self) -> list[str]:
        """Return the names of the effects that are on."""
        return [field.name for field in fields(self) if getattr(self, field.name)]
