"""The scenes of the paper's Fig. 14, for Mitsuba, and where all others are."""

from pathlib import Path

from benchmarks.places import ROOT, shared_data

STILL_LIFE = "still_life.xml"

# Names of the parameters for the width and the height of scenes, or for both.
SIDES = {
    STILL_LIFE: ("width", "height"),
    "checker_horizon.xml": ("resx", "resy"),
    "dof_row.xml": ("resx", "resy"),
    "envmap_glass.xml": ("resx", "resy"),
    "fog_spot.xml": ("resx", "resy"),
    "mis_plates.xml": ("resx", "resy"),
    "small_light_caustic.xml": ("resx", "resy"),
    "textured_wall.xml": ("resx", "resy"),
    "cbox/scene.xml": ("res",),
}


def scene_file(name: str) -> Path:
    """Return where a scene of `SIDES` is: the still life ships, the others are shared data."""
    if name == STILL_LIFE:
        return ROOT / "sampling" / "scenes" / name
    return shared_data() / "scenes" / name


def sized(name: str, side: int) -> dict[str, str]:
    """Return the parameters that make a scene of `SIDES` square."""
    return dict.fromkeys(SIDES[name], str(side))
