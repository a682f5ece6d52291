"""The scenes of the paper's Fig. 14, for Mitsuba."""
