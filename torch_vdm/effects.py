"""Which effects are simulated."""

from dataclasses import dataclass, fields

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

    def names(self) -> list[str]:
        """Return the names of the effects that are on."""
        return [field.name for field in fields(self) if getattr(self, field.name)]
